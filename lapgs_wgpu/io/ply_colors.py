"""The colors of a .ply file's points, by the names and in the types of many programs."""

from __future__ import annotations

import numpy as np

from lapgs_wgpu.io.ply_elements import Element, Floats, PlyFile

SH_C0 = 0.28209479177387814  # the harmonic of degree 0: f_dc * SH_C0 + 0.5 is a color
_PREFIXES = ("", "diffuse_", "vertex_", "scalar_", "ambient_", "color_", "cd_")
_TRIPLES = [
    [f"{before}{name}" for name in names] for before in _PREFIXES for names in (("red", "green", "blue"), "rgb")
]


def read_colors(ply: PlyFile, vertex: Element) -> Floats | None:
    """Read colors (N, 3) in [0, 1], float32; None where no properties are known as colors.

    Integers are of 255, larger ones of 65535; floating-point numbers of 1 where none is far above. Values that are NaN
    become mid-gray.
    """
    names = {name.lower(): name for name in vertex.properties}
    if {"f_dc_0", "f_dc_1", "f_dc_2"} <= set(names):
        values = ply.columns(vertex, [names[f"f_dc_{channel}"] for channel in range(3)]) * np.float32(SH_C0) + 0.5
        return _clipped(values)
    found = next((triple for triple in _TRIPLES if set(triple) <= set(names)), None)
    if found is None:
        return None
    chosen = [names[name] for name in found]
    values = ply.columns(vertex, chosen)
    brightest = np.max(values, where=np.isfinite(values), initial=0.0)
    fractions = all(vertex.properties[name].kind == "f" for name in chosen)
    if fractions and brightest < 2:  # some are a little above 1
        return _clipped(values)
    return _clipped(values / np.float32(255 if brightest < 256 else 65535))


def _clipped(values: Floats) -> Floats:
    return np.nan_to_num(values, nan=0.5).clip(0, 1).astype(np.float32, copy=False)
