"""The interactive viewer: puts state, viewport, mouse, keys and panels together. It draws only what has changed."""

import math
import time
from collections.abc import Callable
from typing import Any

from lapgs_wgpu.errors import DeviceError
from lapgs_wgpu.viewer.controls import BY_KEY, ORBIT, ZOOM
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import SETTLED, Viewport

_GUI_DRAWS = 3  # after an event, until the panels have found their sizes and colors


class App:
    """A viewer on a rendercanvas and its event loop.

    drawing_seconds: that the last draw took, GUI included. failed: what ended it, if the device did. end: called then.
    pointer: its last position on the canvas, logical pixels.
    """

    def __init__(self, canvas: Any, loop: Any, scene: LoadedScene) -> None:
        self.canvas, self.loop = canvas, loop
        self.state = ViewState(scene)
        self.viewport = Viewport(canvas, self.state)
        self._gui: Any = None  # created after the first frame, which does not wait for it
        self._gui_draws = _GUI_DRAWS
        self.pointer = (0.0, 0.0)
        self._dragging: str | None = None
        self._drawn_at, self._running = time.perf_counter(), False
        self.drawing_seconds = 0.0
        self.failed: DeviceError | None = None
        self.end: Callable[[], None] = canvas.close
        canvas.request_draw(self._draw)
        pointer = ("pointer_down", "pointer_move", "pointer_up", "double_click", "wheel")
        canvas.add_event_handler(self._on_pointer, *pointer)
        canvas.add_event_handler(self._on_key_down, "key_down")
        # Panels react to everything, so everything asks for a draw; what has not changed is only presented again.
        canvas.add_event_handler(self._wake, *pointer, "key_down", "key_up", "char", "resize", order=-100)

    def _draw(self) -> None:
        try:
            self._draw_frame()
        except DeviceError as error:  # rendercanvas would log it, and go on with a window that stands still
            self.failed = self.failed or error
            self.end()

    def _draw_frame(self) -> None:
        state, now = self.state, time.perf_counter()
        # Time passes between two frames of something that runs, not while the window was idle, or not drawn for long.
        passed = min(now - self._drawn_at, 0.25) if self._running else 0.0
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

    def _wake(self, event: dict[str, Any]) -> None:
        self._gui_draws = _GUI_DRAWS
        self.canvas.request_draw()

    def _on_key_down(self, event: dict[str, Any]) -> None:
        name = event["key"].lower() if len(event["key"]) == 1 else event["key"]  # letters without Shift
        key = BY_KEY.get(name) if "Control" not in event["modifiers"] else None
        if key is None:
            return
        if key.action == "focus":
            self.viewport.focus(*self.pointer)
        elif key.do is not None:
            key.do(self.state)
        else:
            setattr(self.state, key.action, not getattr(self.state, key.action))

    def _on_pointer(self, event: dict[str, Any]) -> None:
        (x, y), last = (event["x"], event["y"]), self.pointer
        self.pointer = (x, y)
        kind, camera = event["event_type"], self.state.camera
        if kind == "pointer_up":
            self._dragging = None
        elif kind == "pointer_move" and self._dragging == "orbit":
            camera.orbit(ORBIT * (x - last[0]), ORBIT * (y - last[1]))
        elif kind == "pointer_move" and self._dragging == "pan":
            height = self.canvas.get_logical_size()[1]
            camera.pan((x - last[0]) / height, (y - last[1]) / height)
        elif kind == "pointer_move" or (self._gui and self._gui.covers(x, y)):
            return
        elif kind == "pointer_down":
            self._dragging = "pan" if event["button"] != 1 or "Shift" in event["modifiers"] else "orbit"
        elif kind == "double_click":
            self.viewport.focus(x, y)
        else:
            camera.zoom(math.exp(ZOOM * event["dy"]))
