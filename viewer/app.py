"""The interactive viewer: puts state, viewport, controls and panels together. It draws only what has changed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from lapgs_wgpu.errors import DeviceError, InputError

from .controls import Controls
from .loaded_scene import LoadedScene, load_scene
from .view_state import ViewState
from .viewport import SETTLED, Viewport

_GUI_DRAWS = 3  # after an event, until the panels have found their sizes and colors


class App:
    """A viewer on a rendercanvas and its event loop. drawing_seconds: spent on drawing so far, GUI included."""

    def __init__(self, canvas: Any, loop: Any, scene: LoadedScene, *, transport: bool | None = None) -> None:
        self.canvas, self.loop = canvas, loop
        self.state = ViewState(scene, transport=transport)
        self.viewport = Viewport(canvas, self.state)
        self._gui: Any = None  # created after the first frame, which does not wait for it
        self._gui_draws = _GUI_DRAWS
        self.controls = Controls(self.state, self.viewport, covered=self._covered, wake=self._wake)
        self._drawn_at, self._running = time.perf_counter(), False
        self.drawing_seconds = 0.0
        canvas.request_draw(self._draw)

    def open(self, path: Path) -> None:
        """Show another file. If it cannot be read or is too large: keep the present scene, and show a message."""
        before = [(part, vars(part).copy()) for part in (self.state, self.viewport)]
        try:
            self.state.show(load_scene(path, lambda: self.viewport.device))
            self.viewport.draw(time.perf_counter())  # some buffers are allocated only now
        except (InputError, DeviceError, MemoryError) as error:
            for part, attributes in before:
                vars(part).update(attributes)
            if not isinstance(error, InputError):
                error = InputError(f"{path} cannot be shown: {str(error) or 'out of memory'}.")
            self.state.message = str(error)
        self.canvas.request_draw()

    def _draw(self) -> None:
        state, now = self.state, time.perf_counter()
        # Time passes between two frames of something that runs, not while the window was idle before it.
        passed = now - self._drawn_at if self._running else 0.0
        self._drawn_at, self._running = now, state.clock.playing or self.controls.flying
        state.clock.advance(passed)
        self.controls.fly(passed)
        previewed = state.path.preview(now)  # of this very moment, however long the last frame took
        if previewed is not None:
            state.stand_on(*previewed)
        self.viewport.draw(now)
        self.viewport.present()
        if self._gui is None:
            from .panels import Panels

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
