"""The table of keys and mouse gestures: what is handled, and what the help shows."""

from __future__ import annotations

from typing import NamedTuple


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
