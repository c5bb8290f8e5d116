"""The interactive viewer: a canvas, what is shown on it, and what mouse and keys do. It draws only what has changed."""

from __future__ import annotations

import math
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lapgs_wgpu.errors import DeviceError, InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera

from .capture import Capture, open_capture
from .choices import BACKGROUNDS, Mode
from .clock import LOOPS, SPEEDS
from .controls import Controls
from .frame import Frame, Painter, Request
from .opened import Opened, open_scene
from .path import Pose
from .path_editor import PathEditor
from .present import Placed, Presenter

if TYPE_CHECKING:
    from .live import Training

Compare = Literal["off", "side", "split", "error"]
COMPARES: tuple[Compare, ...] = ("off", "side", "split", "error")
MARGIN = (0.11, 0.11, 0.12)  # what surrounds a picture that does not fill the window
_TARGET_SECONDS = 1 / 12  # a frame may take while something moves; beyond it the resolution falls
_SETTLED = 0.2  # seconds without a change after which the full resolution is drawn
_SMALLEST = 0.25  # share of the window's width and height
_ERROR_GAIN = 4.0
_GUI_DRAWS = 3  # after an event, until the panels have found their sizes and colours


class App:
    """What the window shows. The panels (viewer/panels) read and set its attributes, keys call its methods.

    scale: of the frame on show against the window, 1 at full resolution. message: for the user, None or one sentence.
    moved_at: when what is shown was last changed, but for `refresh`. drawing_seconds: spent so far, GUI included.
    stale: the scene has changed since it was drawn.
    training: the training under way, None where a file is shown.
    """

    def __init__(self, canvas: Any, loop: Any, opened: Opened, *, transport: bool | None = None) -> None:
        self.canvas, self.loop = canvas, loop
        self.device: Device = opened.playback.device
        context = canvas.get_wgpu_context()
        wanted = context.get_preferred_format(self.device.wgpu_device.adapter)
        self.format = wanted.removesuffix("-srgb")  # colours are stored as they are seen
        context.configure(device=self.device.wgpu_device, format=self.format)
        self._context = context
        self._presenter = Presenter(self.device, self.format)
        self._gui: Any = None  # made after the first picture, for which nobody should have to wait
        self._gui_draws = _GUI_DRAWS

        self.mode: Mode = "rgb"
        self.compare: Compare = "off"
        self.split = 0.5
        self.show_panels = self.show_overlay = True
        self.show_help = False
        self.show_path = False  # in the panel, from the next draw on
        self.flying = False
        self.profiling = False
        self.message: str | None = None
        self.frame: Frame | None = None
        self.scale = 1.0
        self._moving_scale = 1.0
        self._drawn_key: Any = None
        self.stale = self._running = False
        self.moved_at = self._drawn_at = time.perf_counter()
        self.drawing_seconds = 0.0
        self.training: Training | None = None
        self._capture: Capture | None = None
        self._capture_sought = False
        self._times: deque[float] = deque(maxlen=30)
        self._transport = transport
        self._show(opened)

        self.controls = Controls(self)
        canvas.request_draw(self._draw)

    def open(self, path: Path) -> None:
        """Show another file; where it cannot be read or is too large, say why and keep the present one."""
        before = vars(self).copy()
        try:
            self._show(open_scene(path, lambda: self.device))
            self._paint(time.perf_counter())  # some of what a device has no room for is only needed now
        except (InputError, DeviceError, MemoryError) as error:
            vars(self).update(before)
            if not isinstance(error, InputError):
                error = InputError(f"{path} cannot be shown: {str(error) or 'out of memory'}.")
            self.message = str(error)
        self.canvas.request_draw()

    @property
    def capture(self) -> Capture | None:
        """What the scene was trained on, where that is here. Looked for when it is first needed, not before the first
        picture."""
        if not self._capture_sought:
            opened = self.opened
            self._capture = open_capture(opened.path, opened.playback.metadata) if opened.path else None
            self._capture_sought = True
        return self._capture

    def refresh(self) -> None:
        """The scene itself has changed: draw it again."""
        self.stale = True
        self.painter.forget()
        self.canvas.request_draw()

    def _show(self, opened: Opened) -> None:
        self.opened = opened
        self.painter = Painter(opened.playback)
        self.camera, self.clock = opened.camera(), opened.clock()
        self.path = PathEditor()
        self.background = opened.background
        self.show_transport = opened.playback.moves if self._transport is None else self._transport
        self._capture_sought = False
        self.view: int | None = None
        if self.mode not in self.painter.modes():
            self.mode = "rgb"
        self.message = None if opened.playback.moves else "no motion data in this file"
        self._drawn_key = None

    # Drawing ---------------------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        now = time.perf_counter()
        # Time passes between two frames of something that runs, not while the window rested before it.
        passed = now - self._drawn_at if self._running else 0.0
        self._drawn_at, self._running = now, self.clock.playing or self.controls.flying
        self.clock.advance(passed)
        self.controls.fly(passed)
        previewed = self.path.preview(now)  # of this very moment, however long the last frame took
        if previewed is not None:
            self.stand_on(*previewed)
        self._paint(now)
        self._present()
        if self._gui is None:
            from .panels import Panels

            self._gui = Panels(self)
        else:
            self._gui.render()
            self._gui_draws -= 1
        if self.clock.playing or self.controls.flying or self._gui_draws > 0 or previewed is not None:
            self.canvas.request_draw()
        elif not self._rests():
            self.loop.call_later(_SETTLED, self.canvas.request_draw)
        self.drawing_seconds += time.perf_counter() - now

    def _paint(self, now: float) -> None:
        """Draw the scene where something changed: at a lower resolution and not quite exactly while it changes, in full
        once it rests."""
        whole = self._whole()
        key = (_key(whole), self.clock.time, self.mode, self.background, self.profiling, id(self.painter))
        changed = key != self._drawn_key
        if changed:
            self.moved_at = now
        elif not self.stale and (self._rests() or now - self.moved_at < _SETTLED):
            return
        first = self._drawn_key is None
        moving = changed and not first
        self.scale = self._moving_scale if moving else 1.0
        camera = whole
        if self.scale < 1:
            camera = whole.resized(max(1, round(self.scale * whole.width)), max(1, round(self.scale * whole.height)))
        request = Request(camera, self.clock.time, self.mode, self.background)
        passing = moving and self.comparing() == "off"
        self.frame = self.painter.draw(request, passing=passing, profile=self.profiling)
        self._drawn_key, self.stale = key, False
        self._times.append(time.perf_counter())
        if moving:
            ideal = self.scale * math.sqrt(_TARGET_SECONDS / max(self.frame.seconds, 1e-4))
            ideal = 0.5 * (self._moving_scale + ideal)
            self._moving_scale = min(max(math.floor(16 * ideal) / 16, _SMALLEST), 1.0)

    def _rests(self) -> bool:
        """Whether the frame on show is what is shown while nothing moves."""
        return self.scale == 1 and self.frame is not None and self.frame.exact

    def _whole(self) -> Camera:
        """The camera at full resolution: the window's, or that of the picture from which ours is subtracted."""
        comparing = self.comparing()
        if comparing == "error" and self.camera.exact is not None:
            return self.camera.exact
        width, height = self.canvas.get_physical_size()
        return self.camera.camera(max(1, width // 2 if comparing == "side" else width), max(1, height))

    def _present(self) -> None:
        assert self.frame is not None
        target = self._context.get_current_texture()
        width, height = target.size[:2]
        self._presenter(target.create_view(), self._placed(width, height), MARGIN)

    def _placed(self, width: int, height: int) -> list[Placed]:
        """The frame on a window of this size, with the ground truth where the two are compared."""
        assert self.frame is not None
        compare = self.comparing()
        picture = self.frame.placed
        columns = width // 2 if compare == "side" else width
        if compare != "off" and self.capture is not None and self.view is not None:
            picture = picture._replace(**self.capture.truth(self.view, self.background, self.device))
        if compare == "side":
            right = _fit(picture._replace(truth_until=0.0), columns, height, columns)
            return [_fit(picture._replace(truth_until=1.0), columns, height, 0), right]
        if compare == "split":
            picture = picture._replace(truth_until=self.split)
        elif compare == "error":
            picture = picture._replace(error_gain=_ERROR_GAIN)
        return [_fit(picture, columns, height, 0)]

    def comparing(self) -> Compare:
        """How the capture's picture is shown beside ours: not at all where there is none of this camera and time."""
        if self.view is None or self.camera.exact is None or self.mode != "rgb" or self.capture is None:
            return "off"
        return self.compare if abs(self.clock.time - self.capture.views[self.view].time) < 1e-6 else "off"

    @property
    def fps(self) -> float:
        """Frames of the scene drawn in the last second."""
        recent = [moment for moment in self._times if moment > time.perf_counter() - 1.0]
        return len(recent) - 1.0 if len(recent) > 1 else 0.0

    # What the keys do (viewer/keys) ----------------------------------------------------------------------------------

    def toggle_playing(self) -> None:
        if self.opened.playback.moves:
            self.clock.toggle()

    def previous_frame(self) -> None:
        self.clock.step(-1)

    def next_frame(self) -> None:
        self.clock.step(1)

    def first_frame(self) -> None:
        self.clock.seek(0.0)

    def last_frame(self) -> None:
        self.clock.seek(1.0)

    def slower(self) -> None:
        self.clock.speed = max((s for s in SPEEDS if s < self.clock.speed), default=SPEEDS[0])

    def faster(self) -> None:
        self.clock.speed = min((s for s in SPEEDS if s > self.clock.speed), default=SPEEDS[-1])

    def next_loop(self) -> None:
        self.clock.loop = _next(LOOPS, self.clock.loop)

    def next_mode(self) -> None:
        self.mode = _next(self.painter.modes(), self.mode)

    def next_background(self) -> None:
        self.background = _next(list(BACKGROUNDS.values()), self.background)

    def reset_camera(self) -> None:
        self.camera.reset()

    def toggle_flying(self) -> None:
        self.flying = not self.flying
        self.controls.release()

    def next_view(self) -> None:
        if self.capture is not None:
            self.stand_at((self.view + 1 if self.view is not None else 0) % len(self.capture.views))

    def next_compare(self) -> None:
        if self.capture is None:
            self.message = "nothing to compare with: the run folder beside this file names no capture that is here"
            return
        if self.view is None or self.camera.exact is None:
            self.stand_at(self.view or 0)
        self.compare = _next(COMPARES, self.compare)

    def toggle_pause(self) -> None:
        if self.training is not None:
            self.training.paused = not self.training.paused

    def step_training(self) -> None:
        if self.training is not None:
            self.training.paused = True
            self.training.single += 1

    def add_key_frame(self) -> None:
        self.path.add(self.camera, self.clock.time)
        self.show_path = True

    def toggle_overlay(self) -> None:
        self.show_overlay = not self.show_overlay

    def toggle_transport(self) -> None:
        self.show_transport = not self.show_transport

    def toggle_panels(self) -> None:
        self.show_panels = not self.show_panels

    def toggle_help(self) -> None:
        self.show_help = not self.show_help

    def stand_at(self, view: int) -> None:
        """Go to a camera of the capture, and to its time."""
        assert self.capture is not None
        self.view = view
        self.camera.snap(self.capture.views[view].camera)
        self.clock.playing = False
        self.clock.seek(self.capture.views[view].time)

    def stand_on(self, pose: Pose, time: float) -> None:
        """Go to a pose of a camera path, and to a time."""
        self.camera.stand(pose.position, pose.rotation, pose.fov_y)
        self.clock.playing = False
        self.clock.seek(time)

    def focus(self) -> None:
        """Turn about what lies under the pointer."""
        place = self.on_picture(*self.controls.pointer)
        if place is None or self.frame is None:
            return
        camera = self.frame.request.camera
        column, row = int(place[0] * camera.width), int(place[1] * camera.height)
        depth = self.painter.depth_at(self.frame, column, row)
        self._drawn_key = None  # the frame's buffers hold the depth now
        if depth is not None:
            K, T = camera.K, camera.T_cam_world
            ray = [(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0]
            self.camera.focus_on(camera.position + depth * (T[:3, :3].T @ ray))

    # For the controls ------------------------------------------------------------------------------------------------

    def wake(self) -> None:
        """Something happened that may change the picture or a panel."""
        self._gui_draws = _GUI_DRAWS
        self.canvas.request_draw()

    def covered(self, x: float, y: float) -> bool:
        """Whether a place on the canvas, logical pixels, lies under a panel."""
        return self._gui is not None and self._gui.covers(x, y)

    def on_picture(self, x: float, y: float) -> tuple[float, float] | None:
        """A place on the canvas, logical pixels, as shares of the picture's width and height; None beside it. Of two
        pictures the right one counts."""
        if self.frame is None:
            return None
        placed = self._placed(*self.canvas.get_physical_size())[-1]
        ratio = self.canvas.get_pixel_ratio()
        across, down = (
            (at * ratio - start) / length for at, start, length in zip((x, y), placed.origin, placed.size, strict=True)
        )
        return (across, down) if 0 <= across < 1 and 0 <= down < 1 else None


def _next(choices: Any, present: Any) -> Any:
    return choices[(choices.index(present) + 1) % len(choices)] if present in choices else choices[0]


def _key(camera: Camera) -> tuple[bytes, bytes, int, int]:
    return camera.K.tobytes(), camera.T_cam_world.tobytes(), camera.width, camera.height


def _fit(picture: Placed, width: int, height: int, left: int) -> Placed:
    """The picture as large as fits between columns left and left + width, in the middle."""
    columns, rows = picture.picture
    scale = min(width / columns, height / rows)
    # A picture drawn for this window at a lower resolution fills it again, whatever rounding did to its size.
    across, down = (
        most if abs(scale * n - most) <= max(1.0, scale) else max(1, round(scale * n))
        for n, most in ((columns, width), (rows, height))
    )
    return picture._replace(origin=(left + (width - across) // 2, (height - down) // 2), size=(across, down))
