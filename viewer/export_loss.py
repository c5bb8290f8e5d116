"""What an export loses: pictures of what was written against those of the scene that it was made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.motion.playback.playback import Playback
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.video import orbit_views

Written = Callable[[Camera, float], Gaussians[DeviceArray]]  # what a file shows a camera at a time

VISIBLE = 40.0  # dB; below it a file has lost what is seen
_PICTURES = 4


def export_psnr(scene: LoadedScene, written: Written, time: float | None = None, frames: int | None = None) -> float:
    """Draw pictures of a scene and of a file, from an orbit; return the PSNR of the worst, dB, at most 100.

    time: of all, in [0, 1]; by default from the clip's start to its end. frames: of a sequence, whose times the
    pictures have then.
    """
    rasterizer = Rasterizer(scene.playback.device)
    if time is None and not scene.playback.moves:
        time = 0.0
    captured, errors = scene.initial_view.camera, []
    size = captured.width, captured.height
    for camera, t in orbit_views(scene.camera(), size, _PICTURES, time, scene.initial_view.arc):
        t = t if frames is None else round(t * (frames - 1)) / max(1, frames - 1)
        wanted = _draw(rasterizer, scene, scene.playback.at(t), camera)
        found = _draw(rasterizer, scene, written(camera, t), camera)
        errors.append(float(np.mean((found.astype(np.float64) - wanted) ** 2)))
    return min(100.0, -10 * float(np.log10(max(max(errors), 1e-20))))


def of_playback(playback: Playback) -> Written:
    """Draw what an opened file holds."""
    return lambda camera, t: playback.at(t)


def _draw(
    rasterizer: Rasterizer, scene: LoadedScene, gaussians: Gaussians[DeviceArray], camera: Camera
) -> NDArray[np.float32]:
    """Draw an image (3, height, width), clipped to [0, 1]."""
    while True:
        drawing = rasterizer.draw(gaussians, camera, scene.background)
        if not rasterizer.grow_on_overflow(drawing):
            image: NDArray[np.float32] = drawing.image.read()[:3].clip(0, 1)
            return image
