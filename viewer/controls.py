"""Mouse and keyboard: what is handled, and what the help shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import Viewport


class KeyBinding(NamedTuple):
    """A key and what it does.

    key: as the canvas names it. shown: in the help. action: a method or a flag of ViewState, or focus (of Viewport).
    """

    key: str
    shown: str
    action: str
    help: str


KEYS = (
    KeyBinding(" ", "Space", "toggle_playing", "play or pause"),
    KeyBinding(",", ",", "previous_frame", "a frame back"),
    KeyBinding(".", ".", "next_frame", "a frame on"),
    KeyBinding("Home", "Home", "first_frame", "to the start"),
    KeyBinding("End", "End", "last_frame", "to the end"),
    KeyBinding("[", "[", "slower", "play slower"),
    KeyBinding("]", "]", "faster", "play faster"),
    KeyBinding("l", "L", "next_loop", "at the end: loop, bounce or stop"),
    KeyBinding("m", "M", "next_mode", "what is shown: colors, depth, coverage, motion"),
    KeyBinding("b", "B", "next_background", "background: black, white or grey"),
    KeyBinding("x", "X", "antialiased", "antialiased or not (Mip-Splatting's filter)"),
    KeyBinding("f", "F", "focus", "turn about what lies under the pointer (a double click does the same)"),
    KeyBinding("r", "R", "reset_camera", "camera back to where it started"),
    KeyBinding("n", "N", "next_view", "stand at the capture's next camera, at its time"),
    KeyBinding("p", "P", "toggle_pause", "pause a training that is watched, or let it go on"),
    KeyBinding("s", "S", "step_training", "one step of a training, then pause"),
    KeyBinding("o", "O", "show_overlay", "frames a second, milliseconds, splats, adapter"),
    KeyBinding("t", "T", "show_transport", "the time slider"),
    KeyBinding("h", "H", "show_panels", "all panels"),
    KeyBinding("?", "?", "show_help", "this help"),
)
MOUSE = (
    ("left drag", "turn about the focus"),
    ("right or middle drag, Shift + left drag", "move sideways"),
    ("wheel", "nearer or farther"),
    ("double click", "turn about what lies there"),
)
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
