"""Mouse and keyboard: what keys do, and what the help shows."""

from collections.abc import Callable
from typing import NamedTuple

from lapgs_wgpu.viewer.view_state import ViewState


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
BY_KEY = {key.key: key for key in KEYS} | {"/": KEYS[-1]}  # "?" may arrive as "/" with Shift
ORBIT = 0.008  # radians a pixel of dragging
ZOOM = 0.0015  # of the distance's logarithm a pixel of the wheel
