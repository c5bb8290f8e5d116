"""Gaussian splats in OpenUSD files, read through usd-core."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.viewer.moving_files import MovingFile

KIND = "ParticleField3DGaussianSplat"
HARMONICS = "radiance:sphericalHarmonicsCoefficients"


def read_usd(path: Path) -> MovingFile:
    """Read the first Gaussian splat of a stage, in its own coordinates. Raises InputError."""
    pxr = load_pxr()
    try:
        stage = pxr.Usd.Stage.Open(str(path))
    except pxr.Tf.ErrorException as error:
        raise InputError(f"{path}: usd-core cannot open it ({str(error).splitlines()[0][:200]}).") from None
    prim = next((prim for prim in stage.Traverse() if prim.GetTypeName() == KIND), None)
    if prim is None:
        raise InputError(f"{path}: holds no prim of the type {KIND} (OpenUSD 26.03); other splats are not read.")

    place = prim.GetPath()

    def get(name: str, code: float) -> NDArray[Any]:
        held = stage.GetPrimAtPath(place)  # which holds the stage, too
        values = held.GetAttribute(name).Get(code)
        if values is None:
            values = held.GetAttribute(f"{name}h").Get(code)  # in half precision
        return np.array(values if values is not None else [], np.float32)

    count = len(get("positions", 0))
    degree = int(prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() or 0)
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    shapes = {"positions": (count, 3), "orientations": (count, 4), "scales": (count, 3), "opacities": (count,)}
    shapes[HARMONICS] = (count * (degree + 1) ** 2, 3)

    @lru_cache(maxsize=2)
    def sample(t: float) -> Gaussians[NDArray[np.float32]]:
        found = {name: get(name, start + t * (end - start)) for name in shapes}
        for name, shape in shapes.items():
            if found[name].shape != shape or not count or not np.isfinite(found[name]).all():
                raise InputError(f"{path}: {name} of {place} has shape {found[name].shape}, not finite {shape}.")
        means, quats, scales, opacities, sh = found.values()
        sh = sh.reshape(count, -1, 3)
        return Gaussians(means, np.roll(quats, 1, axis=1), scales, opacities, sh)

    data = dict(stage.GetRootLayer().customLayerData)
    metadata = {"fps": str(stage.GetTimeCodesPerSecond())} | {k: str(v) for k, v in data.items() if k == "view"}
    return MovingFile(sample, max(1, round(end - start) + 1), metadata)


def load_pxr() -> Any:
    """Import usd-core. Raises InputError where it is missing."""
    for name in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdUtils", "Vt"):
        optional_module(f"pxr.{name}", "OpenUSD files need usd-core", "usd")
    return optional_module("pxr", "OpenUSD files need usd-core", "usd")
