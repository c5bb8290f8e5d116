"""Rows of LLFF's poses_bounds.npy, which the formats Neu3D and EndoNeRF share.

A row of 17 numbers holds a 3x5 matrix [R, position, (height, width, focal length)], then nearest and furthest depth.
The pose is camera to world; which axes the columns of R are is each format's own matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import read_npy
from lapgs_wgpu.data.json_fields import LARGEST_ENTRY, LARGEST_SIDE
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import check_rotation
from lapgs_wgpu.errors import InputError

POSES = "poses_bounds.npy"
Array = NDArray[np.float64]


class PoseRow(NamedTuple):
    """One row. R: (3, 3) rotation, columns as stored. position: (3,). depths: nearest and furthest. where: file and
    row, for errors."""

    lens: Lens
    R: Array
    position: Array
    depths: tuple[float, float]
    where: str


def read_rows(path: Path, names: Sequence[str], what: str) -> list[PoseRow]:
    """Read a row for each of the names, in their order. names: at least one, of `what`, such as "images".

    Raises InputError: the file is not readable, has another number of rows, or one of them is no camera.
    """
    rows = read_npy(path).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise InputError(f"{path} must hold 17 numbers a pose, an array of (poses, 17), got {rows.shape}.")
    if len(rows) != len(names):
        raise InputError(
            f"{path} holds {len(rows)} poses, but there are {len(names)} {what}, {names[0]} to {names[-1]}; each of "
            "them needs a row, in this order."
        )
    return [_row(row, f"{path}, row {i} ({name})") for i, (row, name) in enumerate(zip(rows, names, strict=True))]


def _row(row: Array, where: str) -> PoseRow:
    """Check a row (17,). Raises InputError."""
    bad = ~(np.abs(row) <= LARGEST_ENTRY)  # true for NaN, too
    if bad.any():
        column = int(np.argmax(bad))
        raise InputError(f"{where} holds {row[column]:g} in column {column}; it must be at most {LARGEST_ENTRY:g}.")
    pose, (near, far) = row[:15].reshape(3, 5), row[15:]
    height, width, focal = pose[:, 4].tolist()
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE and focal > 0):
        raise InputError(
            f"{where}: height, width and focal length must be positive pixels, got {height:g}, {width:g} and {focal:g}."
        )
    if not 0 < near < far:
        raise InputError(f"{where}: the depth bounds must be 0 < near < far, got {near:g} and {far:g}.")
    check_rotation(pose[:, :3], f"{where}: the pose")
    lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2)
    return PoseRow(lens, pose[:, :3], pose[:, 3], (float(near), float(far)), where)
