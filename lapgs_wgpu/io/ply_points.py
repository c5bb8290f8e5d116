"""Point clouds with colors in .ply files, as written by COLMAP and nerfstudio."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply import Floats, read_columns
from lapgs_wgpu.io.ply_header import MAX_HEADER_BYTES, PathLike, open_ply

COLORS = ["red", "green", "blue"]


def read_points(path: PathLike) -> tuple[Floats, Floats | None]:
    """Read positions (N, 3), and colors (N, 3) in [0, 1], None unless red, green and blue are byte properties.

    Values may be NaN or infinite. Raises InputError if the file is not a point cloud.
    """
    if _is_text(path):
        return _read_text(path)
    with open_ply(path) as (file, elements):
        vertex = elements.get("vertex")
        if vertex is None or not {"x", "y", "z"} <= set(vertex.properties):
            raise InputError(f"{path}: has no element vertex with properties x, y, z, so it is no cloud of points.")
        colored = all(vertex.properties.get(name) == np.uint8 for name in COLORS)
        values = read_columns(file, vertex, ["x", "y", "z", *(COLORS if colored else [])], path)
        return values[:, :3].copy(), values[:, 3:] / np.float32(255) if colored else None


def _is_text(path: PathLike) -> bool:
    with open(path, "rb") as file:
        return re.match(rb"ply\r?\n(comment[^\n]*\n)*format ascii ", file.read(MAX_HEADER_BYTES)) is not None


def _read_text(path: PathLike) -> tuple[Floats, Floats | None]:
    """Read an ASCII file, as nerfstudio writes it. The vertices are the first element, one per line."""
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip() == "end_header"), None)
    if end is None:
        raise InputError(f"{path}: has no line 'end_header'; it is truncated or not a .ply file.")
    words = [line.split() for line in lines[:end]]
    elements = [(i, line) for i, line in enumerate(words) if line[:1] == ["element"]]
    if not elements or elements[0][1][1:2] != ["vertex"] or not re.fullmatch("[0-9]{1,18}", elements[0][1][-1]):
        raise InputError(
            f"{path}: has no element vertex with a count as its first element, so it is no cloud of points."
        )
    start, count = elements[0][0], int(elements[0][1][-1])
    stop = elements[1][0] if len(elements) > 1 else end
    properties = [line for line in words[start + 1 : stop] if line[:1] == ["property"]]
    if short := [line for line in properties if len(line) < 3]:
        raise InputError(f"{path}: {' '.join(short[0])!r} in its header has no type and name; it is damaged.")
    names = [line[-1] for line in properties]
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: has no element vertex with properties x, y, z, so it is no cloud of points.")
    rows = lines[end + 1 : end + 1 + count]
    if len(rows) < count:
        raise InputError(f"{path}: declares {count} vertices, but {len(rows)} lines follow; it is truncated.")
    values = np.empty((count, len(names)), np.float32)
    for index, row in enumerate(rows):
        try:
            with np.errstate(over="ignore"):
                values[index] = np.array(row.split(), dtype=np.float64).reshape(len(names))
        except ValueError:
            raise InputError(
                f"{path}: line {end + 2 + index}, {row[:80]!r}, does not hold {len(names)} numbers; it is damaged."
            ) from None
    bytes_ = {line[-1] for line in properties if line[1] in ("uchar", "uint8")}
    columns = [names.index(name) for name in "xyz"]
    if not set(COLORS) <= bytes_:
        return values[:, columns].copy(), None
    return values[:, columns].copy(), values[:, [names.index(name) for name in COLORS]] / np.float32(255)
