"""The interactive viewer: puts state, viewport, controls and panels together. It draws only what has changed."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lapgs_wgpu.errors import DeviceError, InputError
from lapgs_wgpu.viewer.controls import Controls
from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, load_scene
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import SETTLED, Viewport

_GUI_DRAWS = 3  # after an event, until the panels have found their sizes and colors
_LONGEST_STEP = 0.25  # seconds that the clip and a flight go on at once, after the window could not be drawn


def window_title(path: object) -> str:
    """Return the title of a window that shows a file."""
    return f"{path} - lapgs-view"


class App:
    """A viewer on a rendercanvas and its event loop.

    drawing_seconds: spent on drawing so far, GUI included. failed: what ended it, if the device did. end: called then.
    """

    def __init__(self, canvas: Any, loop: Any, scene: LoadedScene) -> None:
        self.canvas, self.loop = canvas, loop
        self.state = ViewState(scene)
        self.viewport = Viewport(canvas, self.state)
        self._gui: Any = None  # created after the first frame, which does not wait for it
        self._gui_draws = _GUI_DRAWS
        self.controls = Controls(self.state, self.viewport, covered=self._covered, wake=self._wake)
        self._drawn_at, self._running = time.perf_counter(), False
        self.drawing_seconds = 0.0
        self.failed: DeviceError | None = None
        self.end: Callable[[], None] = canvas.close
        canvas.request_draw(self._draw)

    def open(self, path: Path) -> None:
        """Show another file. If it cannot be read or is too large: keep the present scene, and show a message."""
        try:
            asked = self.state.scene
            scene = load_scene(path, lambda: self.viewport.device, up=asked.up, antialiased=asked.antialiased)
            renderer = FrameRenderer(scene.playback)
            width, height = self.canvas.get_physical_size()
            # Some buffers are allocated only when a frame is drawn.
            renderer.draw(FrameRequest(scene.camera().camera(width, height), 0.0, "rgb", scene.background))
        except (InputError, DeviceError, MemoryError) as error:
            if not isinstance(error, InputError):
                error = InputError(f"{path} cannot be shown: {str(error) or 'out of memory'}.")
            self.state.message = str(error)
            self.state.show_panels = True  # which tell of it
        else:
            self.state.show(scene, renderer)
            self.canvas.set_title(window_title(path))
        self.canvas.request_draw()

    def _draw(self) -> None:
        try:
            self._draw_frame()
        except DeviceError as error:  # rendercanvas would log it, and go on with a window that stands still
            self.failed = self.failed or error
            self.end()

    def _draw_frame(self) -> None:
        state, now = self.state, time.perf_counter()
        # Time passes between two frames of something that runs, not while the window was idle before it.
        passed = min(now - self._drawn_at, _LONGEST_STEP) if self._running else 0.0
        self._drawn_at, self._running = now, state.clock.playing or self.controls.flying
        state.clock.advance(passed)
        self.controls.fly(passed)
        previewed = state.path.preview(now)  # of this very moment, however long the last frame took
        if previewed is not None:
            state.stand_on(*previewed)
        self.viewport.draw(now)
        self.viewport.present()
        if self._gui is None:
            from lapgs_wgpu.viewer.panels import Panels

            self._gui = Panels(state, self.viewport, self.open)
        else:
            self._gui.render()
            self._gui_draws -= 1
        if state.clock.playing or self.controls.flying or self._gui_draws > 0 or previewed is not None:
            self.canvas.request_draw()
        elif not self.viewport.at_rest:
            self.loop.call_later(SETTLED, self.canvas.request_draw)
        self.drawing_seconds += time.perf_counter() - now

    def _wake(self) -> None:
        self._gui_draws = _GUI_DRAWS
        self.canvas.request_draw()

    def _covered(self, x: float, y: float) -> bool:
        return self._gui is not None and self._gui.covers(x, y)
