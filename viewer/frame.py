"""Draws a frame: the scene at a time, seen by a camera, as its colors or as one of its values."""

import dataclasses
import time
from typing import Any, NamedTuple

import numpy as np

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.motion.playback.playback import Playback
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.gaussians import switched
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.viewer.render_modes import MODES, Mode


class FrameRequest(NamedTuple):
    """What to draw: equal requests give equal frames. antialiased: None for as the scene says."""

    camera: Camera
    time: float
    mode: Mode
    background: tuple[float, float, float]
    antialiased: bool | None = None


class Frame(NamedTuple):
    """A drawn frame.

    planes: as the rasterizer draws them, (4 or 5, height, width). low, high: the values at the ends of the scale, for
    depth and motion. seconds: until all passes were done. splats: how many touched the image.
    """

    request: FrameRequest
    planes: DeviceArray
    low: float = 0.0
    high: float = 1.0
    seconds: float = 0.0
    splats: int = 0


class FrameRenderer:
    """Draws frames of one scene with buffers of its own; a frame is valid until the next one is drawn.

    moved: how far each Gaussian moves, as colors (N, 3), and the distance at the end of the scale; None before it is
    measured, and to be set where the scene has changed.
    """

    def __init__(self, playback: Playback) -> None:
        self.playback = playback
        self._rasterizer = Rasterizer(playback.device)
        self._pool = BufferPool(playback.device)
        self.moved: tuple[DeviceArray, float] | None = None

    def modes(self) -> list[Mode]:
        """List the modes in which this scene has something to show."""
        return [mode for mode in MODES if mode != "motion" or self.playback.moves]

    def draw(self, request: FrameRequest) -> Frame:
        """Draw, and wait until it is done."""
        start = time.perf_counter()
        low, high, background = 0.0, 1.0, request.background
        changes: dict[str, Any] = {}
        if request.mode == "motion":  # before the Gaussians, which measuring takes to other times
            self.moved = self.moved or self._measure_motion()
            changes["sh"], high = self.moved
            background = (0.0, 0.0, 0.0)
        now = self.playback.at(request.time)
        gaussians = dataclasses.replace(now, antialiased=switched(now.antialiased, request.antialiased), **changes)
        depths = request.mode == "depth"
        drawing = self._rasterizer.draw_whole(gaussians, request.camera, background, depth=depths)
        splats = int(drawing.arrays["visible"].read()[0])
        if depths:
            rest, depth = drawing.image.read()[3:]
            seen = rest < 0.5
            if seen.any():
                low, high = np.percentile(depth[seen] / (1.0 - rest[seen]), [1, 99]).tolist()
        return Frame(request, drawing.image, low, high, time.perf_counter() - start, splats)

    def _measure_motion(self) -> tuple[DeviceArray, float]:
        """Compare the Gaussians' places at nine times of the clip."""
        places = np.stack([self.playback.at(t).means.read() for t in np.linspace(0, 1, 9)])
        moved = np.linalg.norm(places - places.mean(axis=0), axis=2).max(axis=0).astype(np.float32)
        colors = self._pool.upload("motion", np.repeat(moved[:, None], 3, axis=1))
        return colors, max(float(np.percentile(moved, 98)) if len(moved) else 1.0, 1e-9)
