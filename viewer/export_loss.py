"""What an export loses: pictures of what was written against those of the scene that it was made of.

And opacities for players that draw without antialiasing, which lose less.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.motion.playback.playback import Playback
from lapgs_wgpu.splat.camera import Camera, rotation_matrix
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.linear_light import sh_basis
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.viewer.loaded_scene import LoadedScene

Rows = NDArray[np.integer]


class Loss(NamedTuple):
    """psnr: of the worst image, dB, at most 100. reason: which Gaussians differ; empty where the loss is not seen."""

    psnr: float
    reason: str


def measure(
    scene: LoadedScene,
    written: Playback,
    rows: Rows | None = None,
    *,
    time: float | None = None,
    frames: int | None = None,
) -> Loss:
    """Compare four pictures of the captured images' size from around the focus; below 40 dB a loss is seen.

    written: the opened file. rows: which of the scene's Gaussians each of its is, where they are not the same.
    time: of all, in [0, 1]; by default from the clip's start to its end, at times of a sequence of so many frames.
    """
    rasterizer, pictures = Rasterizer(scene.playback.device), []
    for camera, t in scene.around(4, time):
        t = t if frames is None else round(t * (frames - 1)) / max(1, frames - 1)
        true, found = (
            rasterizer.draw_whole(playback.at(t), camera, scene.background).image.read()[:3].clip(0, 1)
            for playback in (scene.playback, written)
        )
        error = float(np.mean((found.astype(np.float64) - true) ** 2))
        pictures.append((min(100.0, -10 * math.log10(max(error, 1e-20))), camera, t))
    psnr, camera, t = min(pictures, key=lambda picture: picture[0])
    return Loss(psnr, "" if psnr >= 40.0 else _reason(scene, written, rows, camera, t))


def _reason(scene: LoadedScene, written: Playback, rows: Rows | None, camera: Camera, t: float) -> str:
    """How many Gaussians, of those that the file shows at a time, differ from the scene's, and in what."""
    shown, exact = written.at(t), scene.playback.at(t)
    found = {name: array.read() for name, array in shown.arrays().items()}
    there = np.flatnonzero(found["opacities"] > 0)
    found = {name: values[there] for name, values in found.items()}
    sources = there if rows is None else rows[there]
    true = {name: array.read()[sources] for name, array in exact.arrays().items()}
    away = np.linalg.norm(true["means"] - found["means"], axis=1)
    lengths = np.linalg.norm(true["quats"], axis=1) * np.linalg.norm(found["quats"], axis=1)
    cosine = np.abs((true["quats"] * found["quats"]).sum(axis=1)) / lengths
    towards = true["means"] - camera.position
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    harmonics = ((sh_basis(towards, int(each["sh"].shape[1] ** 0.5) - 1), each["sh"]) for each in (true, found))
    colors = (np.maximum(np.einsum("nk,nkc->nc", *each) + CONSTANTS["SH_OFFSET"], 0) for each in harmonics)
    differ = {
        "lie off by more than half their size": away > 0.5 * np.median(true["scales"], axis=1),
        "are turned by more than 0.1 rad": 2 * np.arccos(cosine.clip(0, 1)) > 0.1,
        "have another size by more than a tenth": np.abs(np.log(true["scales"] / found["scales"])).max(axis=1) > 0.1,
        "have another opacity by more than 0.05": np.abs(true["opacities"] - found["opacities"]) > 0.05,
        "have another color by more than 0.05": np.abs(np.subtract(*colors)).max(axis=1) > 0.05,
    }
    counts = {what: int(which.sum()) for what, which in differ.items()}
    reasons = [f"{n:,} of {scene.playback.count:,} Gaussians {what}" for what, n in counts.items() if n]
    if exact.antialiased and not shown.antialiased:
        reasons.append("the scene is drawn antialiased, which the file does not say")
    return "; ".join(reasons)


def plain_factors(scene: LoadedScene) -> NDArray[np.floating]:
    """Return the factors (N,) of opacities with which plain drawing comes nearest to the scene's own.

    They are 1 where the scene is not antialiased. Antialiased drawing makes a splat as much fainter as the low-pass
    filter makes it larger, which depends on its size in the image: here the median over eight views around the focus,
    each at another time of the clip, in the size of the captured images and at the distance of the first of them.
    """
    if not scene.playback.at(0.0).antialiased:
        return np.ones(scene.playback.count)
    factors = []
    for camera, t in scene.around(8, None):
        now = scene.playback.at(t)
        means, quats, scales = read_all([now.means, now.quats, now.scales])
        R = camera.T_cam_world[:3, :3]
        local = means @ R.T + camera.T_cam_world[:3, 3]
        ahead = local[:, 2] > 0
        x, y, z = np.where(ahead, local.T, 1.0)
        fx, fy, zero = camera.K[0, 0] / z, camera.K[1, 1] / z, np.zeros(len(z))
        J = np.array([[fx, zero, -fx * x / z], [zero, fy, -fy * y / z]]).transpose(2, 0, 1)
        unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        axes = J @ R @ rotation_matrix(unit.T).transpose(2, 0, 1) * scales[:, None, :]
        covariance = axes @ axes.transpose(0, 2, 1)
        larger = covariance + now.low_pass * np.eye(2)
        # The roots of the areas without and with the low-pass filter.
        faded = np.sqrt(np.linalg.det(covariance).clip(0) / np.linalg.det(larger))
        factors.append(np.where(ahead, faded, 1.0))
    return np.asarray(np.median(factors, axis=0))
