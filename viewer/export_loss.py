"""What an export loses: pictures of what was written against those of the scene that it was made of."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.playback.playback import Playback
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.linear_light import sh_basis
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.viewer.loaded_scene import LoadedScene

Floats = NDArray[np.floating]
Rows = NDArray[np.integer]
# What a file shows a camera at a time, and which Gaussians of the scene these are.
Written = Callable[[Camera, float], tuple[Gaussians[DeviceArray], Rows]]

_PICTURES = 4
_VISIBLE = 40.0  # dB; below it a file has lost what is seen
# Property -> from which error on a Gaussian counts, and what it then does.
_ERRORS = {
    "means": (0.5, "lie off by more than half their size"),
    "quats": (0.1, "are turned by more than 0.1 rad"),
    "scales": (0.1, "have another size by more than a tenth"),
    "opacities": (0.05, "have another opacity by more than 0.05"),
    "sh": (0.05, "have another color by more than 0.05"),
}


class Loss(NamedTuple):
    """psnr: of the worst image, dB, at most 100. reason: which Gaussians differ; empty where the loss is not seen."""

    psnr: float
    reason: str


def measure(scene: LoadedScene, written: Written, time: float | None = None, frames: int | None = None) -> Loss:
    """Compare pictures of the captured images' size from around the focus.

    time: of all, in [0, 1]; by default from the clip's start to its end. frames: of a sequence, whose times the
    pictures have then.
    """
    rasterizer = Rasterizer(scene.playback.device)

    def drawn(gaussians: Gaussians[DeviceArray], camera: Camera) -> Floats:
        """An image (3, height, width), clipped to [0, 1]."""
        return rasterizer.draw_whole(gaussians, camera, scene.background).image.read()[:3].clip(0, 1)

    if time is None and not scene.playback.moves:
        time = 0.0
    pictures = []
    for camera, t in scene.around(_PICTURES, time):
        t = t if frames is None else round(t * (frames - 1)) / max(1, frames - 1)
        wanted = drawn(scene.playback.at(t), camera)
        pictures.append((_psnr(wanted, drawn(written(camera, t)[0], camera)), camera, t, wanted))
    psnr, camera, t, wanted = min(pictures, key=lambda picture: picture[0])
    if psnr >= _VISIBLE:
        return Loss(psnr, "")
    return Loss(psnr, _reason(scene, written, camera, t, lambda gaussians: _psnr(wanted, drawn(gaussians, camera))))


def of_playback(playback: Playback, rows: Rows | None = None) -> Written:
    """Draw what an opened file holds. rows: Gaussians of the scene that are in it, where not all."""
    held = np.arange(playback.count) if rows is None else rows
    return lambda camera, t: (playback.at(t), held)


def _psnr(true: Floats, found: Floats) -> float:
    error = float(np.mean((found.astype(np.float64) - true) ** 2))
    return min(100.0, -10 * math.log10(max(error, 1e-20)))


def _reason(
    scene: LoadedScene, written: Written, camera: Camera, t: float, psnr_of: Callable[[Gaussians[DeviceArray]], float]
) -> str:
    """Which property, taken from the scene, brings the picture nearest to the scene's, and how many Gaussians differ in
    it. psnr_of: of a picture from this camera against the scene's, dB."""
    device = scene.playback.device
    shown, rows = written(camera, t)
    exact = scene.playback.at(t)
    true = {name: array.read()[rows] for name, array in exact.arrays().items()}
    gains = {}
    for name, values in true.items():
        arrays = shown.arrays() | {name: upload(device, values)}
        gains[name] = psnr_of(Gaussians(**arrays, antialiased=shown.antialiased))
    if psnr_of(dataclasses.replace(shown, antialiased=exact.antialiased)) > max(gains.values()):
        return "the scene is drawn antialiased, which the file does not say"
    name = max(gains, key=gains.__getitem__)
    found = {name: array.read() for name, array in shown.arrays().items()}
    most, differ = _ERRORS[name]
    count = int((_errors(name, true, found, camera) > most).sum())
    return f"{count:,} of {scene.playback.count:,} Gaussians {differ}"


def _errors(name: str, true: dict[str, Floats], found: dict[str, Floats], camera: Camera) -> Floats:
    """(N,) by how much a property of each Gaussian differs, as _ERRORS counts it."""
    a: Floats = true[name].astype(np.float64)
    b: Floats = found[name].astype(np.float64)
    if name == "means":
        return np.asarray(np.linalg.norm(a - b, axis=1) / np.median(true["scales"], axis=1))
    if name == "quats":
        cosine = np.abs((a * b).sum(axis=1)) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        return np.asarray(2 * np.arccos(cosine.clip(0, 1)))
    if name == "scales":
        return np.asarray(np.abs(np.log(a / b)).max(axis=1))
    if name == "sh":
        a, b = (_colors(true["means"], sh, camera) for sh in (a, b))
    return np.abs(a - b).reshape(len(a), -1).max(axis=1)


def _colors(means: Floats, sh: Floats, camera: Camera) -> Floats:
    return sh if sh.ndim == 2 else np.maximum(seen(means, sh, camera) + CONSTANTS["SH_OFFSET"], 0)


def seen(means: Floats, sh: Floats, camera: Camera) -> Floats:
    """(N, 3) sums of harmonics (N, K, 3) in the directions from a camera."""
    towards = means - camera.position
    basis = sh_basis(towards / np.linalg.norm(towards, axis=1, keepdims=True), int(sh.shape[1] ** 0.5) - 1)
    return np.asarray(np.einsum("nk,nkc->nc", basis, sh))


def upload(device: Device, values: Floats) -> DeviceArray:
    return DeviceArray.upload(device, "export loss", np.ascontiguousarray(values, np.float32))
