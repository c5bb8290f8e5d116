"""Renders without a window: screenshots and the frames of videos."""

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.present import Presenter
from lapgs_wgpu.viewer.render_modes import Mode


class OffscreenRenderer:
    """Renders images of a scene."""

    def __init__(
        self, scene: LoadedScene, mode: Mode = "rgb", background: tuple[float, float, float] | None = None
    ) -> None:
        self._renderer, self._presenter = FrameRenderer(scene.playback), Presenter(scene.playback.device)
        self._mode, self._background = mode, scene.background if background is None else background

    def __call__(self, camera: Camera, time: float) -> NDArray[np.uint8]:
        """Draw what the camera sees at a time in [0, 1]: (height, width, 3) uint8."""
        frame = self._renderer.draw(FrameRequest(camera, time, self._mode, self._background))
        return self._presenter.picture((camera.width, camera.height), frame)


def framed(camera: Camera, width: int, height: int) -> Camera:
    """Put the camera on a picture of another size and aspect: its vertical field of view stays, pixels stay square
    where they were, and what was in the middle stays there."""
    scale = height / camera.height
    K = camera.K.copy()
    K[:2] *= scale
    K[0, 2] += 0.5 * (width - scale * camera.width)
    return Camera(K, camera.T_cam_world, width, height, camera.near)
