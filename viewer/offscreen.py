"""Renders without a window: screenshots and the frames of videos."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.present import Offscreen
from lapgs_wgpu.viewer.render_modes import Mode

Color = tuple[float, float, float]


class OffscreenRenderer:
    """Renders images of a scene. Raises InputError where the scene has nothing to show in this mode."""

    def __init__(self, scene: LoadedScene, mode: Mode = "rgb", background: Color | None = None) -> None:
        self._renderer = FrameRenderer(scene.playback)
        check_mode(scene, self._renderer, mode)
        self._offscreen = Offscreen(scene.playback.device)
        self._mode = mode
        self._background = scene.background if background is None else background

    def __call__(self, camera: Camera, time: float) -> NDArray[np.uint8]:
        """Draw what the camera sees at a time in [0, 1]: (height, width, 3) uint8."""
        frame = self._renderer.draw(FrameRequest(camera, time, self._mode, self._background))
        return self._offscreen((camera.width, camera.height), frame)


def check_mode(scene: LoadedScene, renderer: FrameRenderer, mode: Mode) -> None:
    """Raises InputError where the scene has nothing to show in this mode."""
    if mode not in renderer.modes():
        raise InputError(f"{scene.path}: has nothing to show in mode {mode}; it has {', '.join(renderer.modes())}.")


def framed(camera: Camera, width: int, height: int) -> Camera:
    """Put the camera on a picture of another size and aspect: its vertical field of view stays, pixels stay square
    where they were, and what was in the middle stays there."""
    scale = height / camera.height
    K = camera.K.copy()
    K[:2] *= scale
    K[0, 2] += 0.5 * (width - scale * camera.width)
    return Camera(K, camera.T_cam_world, width, height, camera.near)
