"""Mouse and keyboard."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from lapgs_wgpu.viewer.key_bindings import KEYS
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import Viewport

_ACTIONS = {key.key: key.action for key in KEYS} | {"/": "show_help"}  # where "?" is told as "/" with Shift
ORBIT = 0.008  # radians a pixel of dragging
ZOOM = 0.0015  # of the distance's logarithm a pixel of the wheel


class Controls:
    """Handles the canvas's events. pointer: its last position on the canvas, logical pixels.

    covered: whether a point of the canvas lies under a panel. wake: draw the canvas and its panels again.
    """

    def __init__(
        self, state: ViewState, viewport: Viewport, *, covered: Callable[[float, float], bool], wake: Callable[[], None]
    ) -> None:
        self.state, self.viewport = state, viewport
        self._covered, self._wake = covered, wake
        self.pointer = (0.0, 0.0)
        self._dragging: str | None = None
        listen = viewport.canvas.add_event_handler
        listen(self._on_pointer_down, "pointer_down")
        listen(self._on_pointer_move, "pointer_move")
        listen(self._on_pointer_up, "pointer_up")
        listen(self._on_double_click, "double_click")
        listen(self._on_wheel, "wheel")
        listen(self._on_key_down, "key_down")
        # Panels react to everything, so everything asks for a draw; what has not changed is only presented again.
        everything = ("pointer_down", "pointer_move", "pointer_up", "wheel", "key_down", "key_up", "char", "resize")
        listen(lambda event: wake(), *everything, order=-100)

    def _on_key_down(self, event: dict[str, Any]) -> None:
        key = event["key"].lower() if len(event["key"]) == 1 else event["key"]  # letters without Shift
        action = _ACTIONS.get(key) if "Control" not in event["modifiers"] else None
        if action == "focus":
            self.viewport.focus(*self.pointer)
        elif action:
            value = getattr(self.state, action)
            if callable(value):
                value()
            else:
                setattr(self.state, action, not value)

    def _on_pointer_down(self, event: dict[str, Any]) -> None:
        self.pointer = (event["x"], event["y"])
        if not self._covered(*self.pointer):
            self._dragging = "pan" if event["button"] != 1 or "Shift" in event["modifiers"] else "orbit"

    def _on_pointer_move(self, event: dict[str, Any]) -> None:
        state, (x, y) = self.state, (event["x"], event["y"])
        right, down = x - self.pointer[0], y - self.pointer[1]
        self.pointer = (x, y)
        if self._dragging == "orbit":
            state.camera.orbit(ORBIT * right, ORBIT * down)
        elif self._dragging == "pan":
            height = self.viewport.canvas.get_logical_size()[1]
            state.camera.pan(right / height, down / height)

    def _on_pointer_up(self, event: dict[str, Any]) -> None:
        self._dragging = None

    def _on_double_click(self, event: dict[str, Any]) -> None:
        self.pointer = (event["x"], event["y"])
        if not self._covered(*self.pointer):
            self.viewport.focus(*self.pointer)
            self._wake()

    def _on_wheel(self, event: dict[str, Any]) -> None:
        self.pointer = (event["x"], event["y"])
        if not self._covered(*self.pointer):
            self.state.camera.zoom(math.exp(ZOOM * event["dy"]))
