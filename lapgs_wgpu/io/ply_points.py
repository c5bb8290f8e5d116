"""A coloured cloud of points in a .ply file, as structure from motion leaves it (COLMAP, and what is made of it)."""

from __future__ import annotations

import numpy as np

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply import Floats, read_columns
from lapgs_wgpu.io.ply_header import PathLike, open_ply

COLOURS = ["red", "green", "blue"]


def read_points(path: PathLike) -> tuple[Floats, Floats | None]:
    """Positions (N, 3), and colours (N, 3) in [0, 1] where the properties red, green and blue are bytes, else None.

    Values may be NaN or infinite. Raises InputError where the file is no binary cloud.
    """
    with open_ply(path) as (file, elements):
        vertex = elements.get("vertex")
        if vertex is None or not {"x", "y", "z"} <= set(vertex.properties):
            raise InputError(f"{path}: has no element vertex with properties x, y, z, so it is no cloud of points.")
        coloured = all(vertex.properties.get(name) == np.uint8 for name in COLOURS)
        values = read_columns(file, vertex, ["x", "y", "z", *(COLOURS if coloured else [])], path)
        return values[:, :3].copy(), values[:, 3:] / np.float32(255) if coloured else None
