"""The canvas's frames: drawn where something changed, at the resolution that keeps up."""

import math
import time
from typing import Any

from lapgs_wgpu.viewer.frame import Frame, FrameRequest
from lapgs_wgpu.viewer.present import Presenter
from lapgs_wgpu.viewer.view_state import ViewState

SETTLED = 0.2  # seconds without a change after which the full resolution is drawn
TARGET_SECONDS = 1 / 12  # for a frame while something moves; where it takes longer, the resolution falls
SMALLEST_SCALE = 0.25  # least resolution, share of the canvas's width and height


class Viewport:
    """Draws a ViewState onto a canvas.

    format: of the canvas's texture. frame: the one on show, None before the first. scale: its resolution, share of
    the canvas's; 1 is the full one. moved_at: when the view last changed, seconds of `time.perf_counter`. stale: to be
    set where the scene itself has changed, until it was drawn.
    """

    def __init__(self, canvas: Any, state: ViewState) -> None:
        self.canvas, self.state = canvas, state
        self.device = state.scene.playback.device
        self._context = canvas.get_wgpu_context()
        wanted = self._context.get_preferred_format(self.device.wgpu_device.adapter)
        self.format = wanted.removesuffix("-srgb")  # our colors are already sRGB
        self._context.configure(device=self.device.wgpu_device, format=self.format)
        self._presenter = Presenter(self.device, self.format)
        self.frame: Frame | None = None
        self.scale = self._moving_scale = 1.0
        self._drawn: tuple[Any, ...] = ()  # all that the frame depends on
        self.stale = False
        self.moved_at = time.perf_counter()

    @property
    def at_rest(self) -> bool:
        """Whether the frame on show is final: of the full resolution."""
        return self.scale == 1 and self.frame is not None

    def draw(self, now: float) -> None:
        """Draw the scene where something changed: at a lower resolution while it changes, in full once
        nothing has changed for SETTLED seconds. now: seconds of `time.perf_counter`."""
        state, (width, height) = self.state, self.canvas.get_physical_size()
        full = state.camera.camera(max(1, width), max(1, height))
        shown = state.clock.time, state.mode, state.background, state.antialiased
        key = full.K.tobytes(), full.T_cam_world.tobytes(), full.width, full.height, *shown
        moving = bool(self._drawn) and key != self._drawn  # not the first frame
        if key != self._drawn:
            self.moved_at = now
        elif not self.stale and (self.at_rest or now - self.moved_at < SETTLED):
            return
        if state.training is not None:
            state.renderer.moved = None
        self.scale = self._moving_scale if moving else 1.0
        camera = full
        if self.scale < 1:
            camera = full.resized(max(1, round(self.scale * full.width)), max(1, round(self.scale * full.height)))
        self.frame = state.renderer.draw(FrameRequest(camera, *shown))
        self._drawn, self.stale = key, False
        if moving:
            ideal = self.scale * math.sqrt(TARGET_SECONDS / max(self.frame.seconds, 1e-4))
            ideal = 0.5 * (self._moving_scale + ideal)
            self._moving_scale = min(max(math.floor(16 * ideal) / 16, SMALLEST_SCALE), 1.0)

    def present(self) -> None:
        """Draw the frame on the canvas's texture."""
        assert self.frame is not None
        target = self._context.get_current_texture()
        self._presenter(target.create_view(), target.size[:2], self.frame)

    def focus(self, x: float, y: float) -> None:
        """Move the camera's focus to the surface under a point of the canvas, logical pixels."""
        across, down = (at / length for at, length in zip((x, y), self.canvas.get_logical_size(), strict=True))
        if self.frame is None or not (0 <= across < 1 and 0 <= down < 1):
            return
        camera = self.frame.request.camera
        column, row = int(across * camera.width), int(down * camera.height)
        depths = self.state.renderer.draw(self.frame.request._replace(mode="depth"))
        self._drawn = ()  # the frame's buffers hold the depth now
        rest, depth = depths.planes.read()[3:, row, column].tolist()
        alpha = 1.0 - rest
        if alpha > 0.1:
            K, T = camera.K, camera.T_cam_world
            ray = [(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0]
            self.state.camera.focus_on(camera.position + depth / alpha * (T[:3, :3].T @ ray))
