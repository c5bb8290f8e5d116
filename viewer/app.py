"""The interactive viewer: puts state, viewport, controls and panels together. It draws only what has changed."""

import time
from collections.abc import Callable
from typing import Any

from lapgs_wgpu.errors import DeviceError
from lapgs_wgpu.viewer.controls import Controls
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import SETTLED, Viewport

_GUI_DRAWS = 3  # after an event, until the panels have found their sizes and colors
_LONGEST_STEP = 0.25  # seconds that the clip goes on at once, after the window could not be drawn


class App:
    """A viewer on a rendercanvas and its event loop.

    drawing_seconds: that the last draw took, GUI included. failed: what ended it, if the device did. end: called then.
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
        self._drawn_at, self._running = now, state.clock.playing
        state.clock.advance(passed)
        self.viewport.draw(now)
        self.viewport.present()
        if self._gui is None:
            from lapgs_wgpu.viewer.panels import Panels

            self._gui = Panels(state, self.viewport)
        else:
            self._gui.render()
            self._gui_draws -= 1
        if state.clock.playing or self._gui_draws > 0:
            self.canvas.request_draw()
        elif not self.viewport.at_rest:
            self.loop.call_later(SETTLED, self.canvas.request_draw)
        self.drawing_seconds = time.perf_counter() - now

    def _wake(self) -> None:
        self._gui_draws = _GUI_DRAWS
        self.canvas.request_draw()

    def _covered(self, x: float, y: float) -> bool:
        return self._gui is not None and self._gui.covers(x, y)
