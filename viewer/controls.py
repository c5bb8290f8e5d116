"""What mouse and keys do to an App."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from .keys import FLY, KEYS

if TYPE_CHECKING:
    from .app import App

_ACTIONS = {key.key: key.action for key in KEYS} | {"/": "toggle_help"}  # where "?" is told as "/" with Shift
_ORBIT = 0.008  # radians a pixel of dragging
_LOOK = 0.4 * _ORBIT  # about the camera itself, where a turn moves more of the picture
_ZOOM = 0.0015  # of the distance's logarithm a pixel of the wheel
_FLY = 0.6  # of the distance to the focus a second
_GRIP = 0.01  # of the width: how near to the split it can be dragged


class Controls:
    """Listens to the App's canvas. pointer: its last place, logical pixels."""

    def __init__(self, app: App) -> None:
        self.app = app
        self.pointer = (0.0, 0.0)
        self._dragging: str | None = None
        self._held: set[str] = set()  # of the keys that fly, and those that say how fast
        listen = app.canvas.add_event_handler
        listen(self._on_pointer_down, "pointer_down")
        listen(self._on_pointer_move, "pointer_move")
        listen(self._on_pointer_up, "pointer_up")
        listen(self._on_double_click, "double_click")
        listen(self._on_wheel, "wheel")
        listen(self._on_key_down, "key_down")
        listen(self._on_key_up, "key_up")
        listen(lambda event: self.release(), "pointer_leave")  # its release may go to another window
        # Panels react to everything, so everything asks for a draw; what has not changed is only presented again.
        everything = ("pointer_down", "pointer_move", "pointer_up", "wheel", "key_down", "key_up", "char", "resize")
        listen(lambda event: app.wake(), *everything, order=-100)

    @property
    def flying(self) -> bool:
        """Whether a key is held that moves the camera."""
        return not self._held.isdisjoint(FLY)

    def release(self) -> None:
        """As if no key were held."""
        self._held.clear()

    def fly(self, seconds: float) -> None:
        """Move the camera by what the held keys say."""
        moves = [FLY[key] for key in self._held if key in FLY]
        if moves:
            fast = 4.0 if "Shift" in self._held else 0.25 if "Alt" in self._held else 1.0
            reach = seconds * _FLY * fast * self.app.camera.distance
            right, down, forward = (reach * sum(axis) for axis in zip(*moves, strict=True))
            self.app.camera.fly(right, down, forward)

    def _on_key_down(self, event: dict[str, Any]) -> None:
        key = event["key"]
        if self.app.flying and (key in ("Shift", "Alt") or key.lower() in FLY):
            self._held.add(key if key in ("Shift", "Alt") else key.lower())
        elif "Control" not in event["modifiers"]:
            action = _ACTIONS.get(key) or _ACTIONS.get(key.lower())
            if action:
                getattr(self.app, action)()

    def _on_key_up(self, event: dict[str, Any]) -> None:
        key = event["key"]
        self._held.discard(key if key in ("Shift", "Alt") else key.lower())

    def _on_pointer_down(self, event: dict[str, Any]) -> None:
        app = self.app
        self.pointer = (event["x"], event["y"])
        if app.covered(*self.pointer):
            return
        app.path.started = None  # whoever takes the camera has it
        place = app.on_picture(*self.pointer)
        if app.comparing() == "split" and place is not None and abs(place[0] - app.split) < _GRIP:
            self._dragging = "split"
        elif event["button"] != 1 or "Shift" in event["modifiers"]:
            self._dragging = "pan"
        else:
            self._dragging = "look" if app.flying else "orbit"

    def _on_pointer_move(self, event: dict[str, Any]) -> None:
        app, (x, y) = self.app, (event["x"], event["y"])
        right, down = x - self.pointer[0], y - self.pointer[1]
        self.pointer = (x, y)
        if self._dragging == "orbit":
            app.camera.orbit(_ORBIT * right, _ORBIT * down)
        elif self._dragging == "look":
            app.camera.look(_LOOK * right, _LOOK * down)
        elif self._dragging == "pan":
            height = app.canvas.get_logical_size()[1]
            app.camera.pan(right / height, down / height)
        elif self._dragging == "split":
            place = app.on_picture(x, y)
            app.split = place[0] if place is not None else app.split

    def _on_pointer_up(self, event: dict[str, Any]) -> None:
        self._dragging = None

    def _on_double_click(self, event: dict[str, Any]) -> None:
        self.pointer = (event["x"], event["y"])
        if not self.app.covered(*self.pointer):
            self.app.focus()
            self.app.wake()

    def _on_wheel(self, event: dict[str, Any]) -> None:
        self.pointer = (event["x"], event["y"])
        if not self.app.covered(*self.pointer):
            self.app.camera.zoom(math.exp(_ZOOM * event["dy"]))
