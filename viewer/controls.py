"""Mouse and keyboard: what is handled, and what the help shows."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.viewport import Viewport


class KeyBinding(NamedTuple):
    """A key and what it does.

    key: as the canvas names it. shown: in the help. action: its name in web pages; without `do`, focus, or the flag of
    ViewState that it turns.
    """

    key: str
    shown: str
    action: str
    help: str
    do: Callable[[ViewState], None] | None = None


KEYS = (
    KeyBinding(" ", "Space", "toggle_playing", "play or pause", lambda state: state.clock.toggle()),
    KeyBinding(",", ",", "previous_frame", "a frame back", lambda state: state.clock.step(-1)),
    KeyBinding(".", ".", "next_frame", "a frame on", lambda state: state.clock.step(1)),
    KeyBinding("Home", "Home", "first_frame", "to the start", lambda state: state.clock.seek(0.0)),
    KeyBinding("End", "End", "last_frame", "to the end", lambda state: state.clock.seek(1.0)),
    KeyBinding("[", "[", "slower", "play slower", lambda state: state.clock.slower()),
    KeyBinding("]", "]", "faster", "play faster", lambda state: state.clock.faster()),
    KeyBinding("l", "L", "next_loop", "at the end: loop, bounce or stop", lambda state: state.clock.next_loop()),
    KeyBinding("m", "M", "next_mode", "what is shown: colors, depth, coverage, motion", ViewState.next_mode),
    KeyBinding("b", "B", "next_background", "background: black, white or grey", ViewState.next_background),
    KeyBinding("x", "X", "antialiased", "antialiased or not (Mip-Splatting's filter)"),
    KeyBinding("f", "F", "focus", "turn about what lies under the pointer (a double click does the same)"),
    KeyBinding("r", "R", "reset_camera", "camera back to where it started", lambda state: state.camera.reset()),
    KeyBinding("n", "N", "next_view", "stand at the capture's next camera, at its time", ViewState.next_view),
    KeyBinding("p", "P", "toggle_pause", "pause a training that is watched, or let it go on", ViewState.toggle_pause),
    KeyBinding("s", "S", "step_training", "one step of a training, then pause", ViewState.step_training),
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
_BY_KEY = {key.key: key for key in KEYS} | {"/": KEYS[-1]}  # "?" may arrive as "/" with Shift
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
        self._covered = covered
        self.pointer = (0.0, 0.0)
        self._dragging: str | None = None
        listen = viewport.canvas.add_event_handler
        pointer = ("pointer_down", "pointer_move", "pointer_up", "double_click", "wheel")
        listen(self._on_pointer, *pointer)
        listen(self._on_key_down, "key_down")
        # Panels react to everything, so everything asks for a draw; what has not changed is only presented again.
        listen(lambda event: wake(), *pointer, "key_down", "key_up", "char", "resize", order=-100)

    def _on_key_down(self, event: dict[str, Any]) -> None:
        name = event["key"].lower() if len(event["key"]) == 1 else event["key"]  # letters without Shift
        key = _BY_KEY.get(name) if "Control" not in event["modifiers"] else None
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
            height = self.viewport.canvas.get_logical_size()[1]
            camera.pan((x - last[0]) / height, (y - last[1]) / height)
        elif kind == "pointer_move" or self._covered(x, y):
            return
        elif kind == "pointer_down":
            self._dragging = "pan" if event["button"] != 1 or "Shift" in event["modifiers"] else "orbit"
        elif kind == "double_click":
            self.viewport.focus(x, y)
        else:
            camera.zoom(math.exp(ZOOM * event["dy"]))
