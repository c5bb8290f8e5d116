"""The one table of keys and mouse moves: what is handled, and what the help shows."""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """key: as the canvas names it. shown: in the help. action: the method of App that it calls."""

    key: str
    shown: str
    action: str
    help: str


KEYS = (
    Key(" ", "Space", "toggle_playing", "play or pause"),
    Key(",", ",", "previous_frame", "a frame back"),
    Key(".", ".", "next_frame", "a frame on"),
    Key("Home", "Home", "first_frame", "to the start"),
    Key("End", "End", "last_frame", "to the end"),
    Key("[", "[", "slower", "play slower"),
    Key("]", "]", "faster", "play faster"),
    Key("l", "L", "next_loop", "at the end: loop, bounce or stop"),
    Key("m", "M", "next_mode", "what is shown: colours, depth, coverage, motion, dynamics, scale"),
    Key("b", "B", "next_background", "background: black, white or grey"),
    Key("f", "F", "focus", "turn about what lies under the pointer (a double click does the same)"),
    Key("r", "R", "reset_camera", "camera back to where it started"),
    Key("v", "V", "toggle_flying", "fly: W A S D move, Q E down and up, Shift fast, Alt slow"),
    Key("n", "N", "next_view", "stand at the capture's next camera, at its time"),
    Key("c", "C", "next_compare", "compare with the capture: side by side, split, error"),
    Key("k", "K", "add_key_frame", "add a key-frame to the camera path"),
    Key("p", "P", "toggle_pause", "pause a training that is watched, or let it go on"),
    Key("s", "S", "step_training", "one step of a training, then pause"),
    Key("o", "O", "toggle_overlay", "frames a second, milliseconds, splats, adapter"),
    Key("t", "T", "toggle_transport", "the time slider"),
    Key("h", "H", "toggle_panels", "all panels"),
    Key("?", "?", "toggle_help", "this help"),
)
MOUSE = (
    ("left drag", "turn about the focus"),
    ("right or middle drag, Shift + left drag", "move sideways"),
    ("wheel", "nearer or farther"),
    ("double click", "turn about what lies there"),
)
FLY = {
    "w": (0, 0, 1),
    "s": (0, 0, -1),
    "a": (-1, 0, 0),
    "d": (1, 0, 0),
    "q": (0, 1, 0),
    "e": (0, -1, 0),
}  # right, down, ahead
