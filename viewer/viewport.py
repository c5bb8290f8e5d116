"""The canvas's frames: drawn where something changed, at the resolution that keeps up, and laid out on the canvas."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Any

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.frame import Frame, FrameRequest
from lapgs_wgpu.viewer.present import ImageLayout, Presenter
from lapgs_wgpu.viewer.view_state import ViewState

SETTLED = 0.2  # seconds without a change after which the full resolution is drawn
MARGIN = (0.11, 0.11, 0.12)  # color around an image that does not fill the canvas
TARGET_SECONDS = 1 / 12  # for a frame while something moves; where it takes longer, the resolution falls
SMALLEST_SCALE = 0.25  # least resolution, share of the canvas's width and height
_ERROR_GAIN = 4.0


class Viewport:
    """Draws a ViewState onto a canvas.

    format: of the canvas's texture. frame: the one on show, None before the first. scale: its resolution, share of
    the canvas's; 1 is the full one. moved_at: when the view last changed, seconds of `time.perf_counter`; `refresh`
    does not count. stale: the scene has changed since it was drawn.
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
        self._drawn: tuple[Any, ...] = ()  # all that the frame depends on, with the renderer at the end
        self.stale = False
        self.moved_at = time.perf_counter()
        self._times: deque[float] = deque(maxlen=30)

    @property
    def fps(self) -> float:
        """Count the frames of the scene drawn in the last second."""
        recent = [drawn for drawn in self._times if drawn > time.perf_counter() - 1.0]
        return len(recent) - 1.0 if len(recent) > 1 else 0.0

    @property
    def at_rest(self) -> bool:
        """Whether the frame on show is final: of the full resolution."""
        return self.scale == 1 and self.frame is not None

    def refresh(self) -> None:
        """Draw again, because the scene itself has changed."""
        self.stale = True
        self.canvas.request_draw()

    def draw(self, now: float) -> None:
        """Draw the scene where something changed: at a lower resolution while it changes, in full once
        nothing has changed for SETTLED seconds. now: seconds of `time.perf_counter`."""
        state, full = self.state, self._full_camera()
        shown = state.clock.time, state.mode, state.background, state.antialiased
        key = (*_camera_key(full), *shown, state.renderer)
        changed = key != self._drawn
        if changed:
            moving = bool(self._drawn) and self._drawn[-1] is state.renderer  # not the first frame of a scene
            self.moved_at = now
        elif not self.stale and (self.at_rest or now - self.moved_at < SETTLED):
            return
        else:
            moving = False
        if state.training is not None:
            state.renderer.forget()
        self.scale = self._moving_scale if moving else 1.0
        camera = full
        if self.scale < 1:
            camera = full.resized(max(1, round(self.scale * full.width)), max(1, round(self.scale * full.height)))
        self.frame = state.renderer.draw(FrameRequest(camera, *shown))
        self._drawn, self.stale = key, False
        self._times.append(time.perf_counter())
        if moving:
            ideal = self.scale * math.sqrt(TARGET_SECONDS / max(self.frame.seconds, 1e-4))
            ideal = 0.5 * (self._moving_scale + ideal)
            self._moving_scale = min(max(math.floor(16 * ideal) / 16, SMALLEST_SCALE), 1.0)

    def present(self) -> None:
        """Copy the frame, with the ground truth where the two are compared, to the canvas's texture."""
        target = self._context.get_current_texture()
        self._presenter(target.create_view(), self._layouts(*target.size[:2]), MARGIN)

    def _full_camera(self) -> Camera:
        """Make the camera at full resolution: the canvas's, or that of the image that is subtracted."""
        comparing, camera = self.state.comparing(), self.state.camera
        if comparing == "error" and camera.exact is not None:
            return camera.exact
        width, height = self.canvas.get_physical_size()
        return camera.camera(max(1, width // 2 if comparing == "side" else width), max(1, height))

    def _layouts(self, width: int, height: int) -> list[ImageLayout]:
        """Lay the frame out on a canvas of this size, pixels."""
        assert self.frame is not None
        layout = self.frame.layout._replace(**self._truth())
        compare = self.state.comparing()
        columns = width // 2 if compare == "side" else width
        if compare == "side":
            right = _fit(layout._replace(truth_until=0.0), columns, height, columns)
            return [_fit(layout._replace(truth_until=1.0), columns, height, 0), right]
        if compare == "split":
            layout = layout._replace(truth_until=self.state.split)
        elif compare == "error":
            layout = layout._replace(error_gain=_ERROR_GAIN)
        return [_fit(layout, columns, height, 0)]

    def _truth(self) -> dict[str, Any]:
        """What `ImageLayout` has to know of the image that is compared with, if any. One that cannot be read ends the
        comparison, with a message."""
        state = self.state
        if state.comparing() == "off" or state.ground_truth is None or state.view is None:
            return {}
        try:
            return state.ground_truth.truth(state.view, state.background, self.device)
        except InputError as error:
            state.compare, state.message = "off", str(error)
            self.canvas.request_draw()
            return {}

    def on_image(self, x: float, y: float) -> tuple[float, float] | None:
        """A point of the canvas (logical pixels) as shares of the image's width and height; None beside the image. Of
        two images the right one counts."""
        if self.frame is None:
            return None
        layout = self._layouts(*self.canvas.get_physical_size())[-1]
        ratio = self.canvas.get_pixel_ratio()
        across, down = (
            (at * ratio - start) / length for at, start, length in zip((x, y), layout.origin, layout.size, strict=True)
        )
        return (across, down) if 0 <= across < 1 and 0 <= down < 1 else None

    def focus(self, x: float, y: float) -> None:
        """Move the camera's focus to the surface under a point of the canvas, logical pixels."""
        point = self.on_image(x, y)
        if point is None or self.frame is None:
            return
        camera = self.frame.request.camera
        column, row = int(point[0] * camera.width), int(point[1] * camera.height)
        depth = self.state.renderer.depth_at(self.frame, column, row)
        self._drawn = ()  # the frame's buffers hold the depth now
        if depth is not None:
            K, T = camera.K, camera.T_cam_world
            ray = [(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0]
            self.state.camera.focus_on(camera.position + depth * (T[:3, :3].T @ ray))


def _camera_key(camera: Camera) -> tuple[bytes, bytes, int, int]:
    return camera.K.tobytes(), camera.T_cam_world.tobytes(), camera.width, camera.height


def _fit(layout: ImageLayout, width: int, height: int, left: int) -> ImageLayout:
    """Center the image, as large as fits, between columns left and left + width."""
    columns, rows = layout.picture
    scale = min(width / columns, height / rows)
    # An image drawn for this canvas at a lower resolution fills it again, whatever rounding did to its size.
    across, down = (
        most if abs(scale * n - most) <= max(1.0, scale) else max(1, round(scale * n))
        for n, most in ((columns, width), (rows, height))
    )
    return layout._replace(origin=(left + (width - across) // 2, (height - down) // 2), size=(across, down))
