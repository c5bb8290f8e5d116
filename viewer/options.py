"""The options of lapgs-view, and which of them go together."""

import argparse
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import PurePath
from typing import Any

from lapgs_wgpu.command import DEVICE_HELP, LIST_DEVICES_HELP, Parser
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.clock import LOOPS
from lapgs_wgpu.viewer.render_modes import AHEAD, BACKGROUNDS, MODES

DESCRIPTION = """\
Display a trained scene, or any 3DGS .ply file, at any time and from any viewpoint.

  lapgs-view runs/demo/checkpoint.ply --time-slider
  lapgs-view runs/demo/checkpoint.ply --play --speed 0.5 --loop bounce
  lapgs-view runs/demo/checkpoint.ply --backend http                  in a browser, also on another machine

Without a display:
  lapgs-view CHECKPOINT.ply --screenshot a.png --time 0.5 --size 1920x1080
  lapgs-view CHECKPOINT.ply --screenshot a.png --view test_000 --mode depth
  lapgs-view CHECKPOINT.ply --video a.mp4                             the clip once; an orbit if the scene is static
  lapgs-view CHECKPOINT.ply --video a.mp4 --path both --seconds 10    one orbit while the clip plays
  lapgs-view CHECKPOINT.ply --export still.ply --time 0.5             static .ply for other splat viewers
  lapgs-view CHECKPOINT.ply --export frames --frames 60               sequence of static .ply files for SuperSplat
  lapgs-view CHECKPOINT.ply --export scene.usdz                       OpenUSD with time samples (Houdini, Omniverse)
  lapgs-view CHECKPOINT.ply --export scene.html                       web page that plays the scene on the visitor's GPU
  lapgs-view CHECKPOINT.ply --export scene.4dgs                       motion as straight lines, for players of .4dgs

[Values in brackets] are defaults.
"""

# What a call does -> the options that it takes beside --device and the one that chooses it.
_PICTURE = {"time", "mode", "background", "view", "up", "antialiased"}
_WINDOW = _PICTURE | {"time_slider", "play", "fps", "speed", "loop", "backend"}
_TAKES = {
    "a window": _WINDOW | {"size"},
    "--backend http": _WINDOW | {"host", "port"},  # the browser's window says the size
    "--list-devices": set[str](),
    "--screenshot": _PICTURE | {"size"},
    "--video": _PICTURE | {"size", "path", "fps", "seconds"},
    "--export FILE.ply": {"time", "antialiased", "overwrite"},
    "--export FILE.lapgs": {"up", "antialiased", "overwrite"},
    "--export FILE.html": {"up", "antialiased", "overwrite"},
    "--export FILE.4dgs": {"up", "max_error", "overwrite"},
    "--export FILE.usd": {"frames", "up", "antialiased", "overwrite"},
    "--export DIR": {"frames", "up", "antialiased", "overwrite"},
}
SIZE = (1280, 720)  # of a window or picture, where nothing else says it
USD = (".usd", ".usda", ".usdc", ".usdz")
_JOBS = ("list_devices", "screenshot", "video", "export")


def parse_options(arguments: Sequence[str]) -> tuple[Any, str]:
    """Parse the command line: the options, None where not given, and the job: one of _JOBS, or the backend. Raises
    InputError where options do not go together; none is silently ignored."""
    given = _parse(arguments)
    jobs = [name for name in _JOBS if getattr(given, name) is not None]
    if len(jobs) > 1:
        raise InputError(f"{_option(jobs[0])} and {_option(jobs[1])} do not go together: one at a time.")
    job = jobs[0] if jobs else given.backend or "glfw"
    for name, ending in (("screenshot", ".png"), ("video", ".mp4")):
        if job == name and not getattr(given, name).lower().endswith(ending):
            raise InputError(f"--{name} {getattr(given, name)}: expected a name that ends with {ending}.")
    place = {"http": "--backend http", "glfw": "a window"}.get(job, _option(job))
    if job == "export":
        ending = PurePath(given.export).suffix.lower()
        ending = ".usd" if ending in USD else ending
        place = f"--export FILE{ending}" if f"--export FILE{ending}" in _TAKES else "--export DIR"
        if place == "--export DIR" and given.frames is None:
            raise InputError(f"--export {given.export}: name a .ply, .lapgs, .html, .4dgs, .usd, or DIR and --frames.")
    for name, value in vars(given).items():
        if value is not None and name not in {"file", "device", job} | _TAKES[place]:
            raise InputError(f"{_option(name)} has no use with {place}.")
    return given, job


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _parse(arguments: Sequence[str]) -> Any:
    parser = Parser("lapgs-view", DESCRIPTION)
    # fmt: off
    add = parser.add_argument
    # All defaults are None, which tells given options from others.
    add("file", nargs="?", metavar="FILE", help="checkpoint, compact scene (.lapgs), any 3DGS .ply file; .4dgs, "
        ".usd, .splatv, Spacetime Gaussians' .ply; a folder of .ply frames or its sequence.json")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--list-devices", action="store_const", const=True, help=LIST_DEVICES_HELP)

    add = parser.add_argument_group("content of the window, screenshot or video").add_argument
    add("--time", type=_within(0.0, 1.0), metavar="T", help="time in the clip, from 0 to 1; also of --export FILE.ply; "
        "not for videos in which the clip plays [0, or the time of --view]")
    add("--mode", choices=list(MODES), help="; ".join(f"{mode}: {about}" for mode, about in MODES.items()) + " [rgb]")
    add("--background", choices=list(BACKGROUNDS), help="color behind the Gaussians [the training's, otherwise black]")
    add("--size", type=_size, metavar="WxH", help="pixels [1280x720, or of a picture that of --view]")
    add("--up", choices=list(AHEAD), help="axis that points up, of a file without cameras [where the file says, "
        "otherwise -y, or z of what lies flat]")
    add("--antialiased", choices=("yes", "no"), help="draw as antialiased trainings do (Mip-Splatting's filter); also "
        "of exports [what the file says]")
    add("--view", metavar="N|NAME", help="camera of the capture by name or number; test views come first [where the "
        "file says, otherwise one that shows the whole scene]")

    add = parser.add_argument_group("window").add_argument
    add("--time-slider", action="store_const", const=True, help="show the time slider [shown if the scene moves]")
    add("--play", action="store_const", const=True, help="start playing at once [paused]")
    add("--fps", type=_within(0.1, 1000.0), metavar="F", help="frames a second at speed 1 and of --video [30]")
    add("--speed", type=_within(0.01, 100.0), metavar="X", help="playback speed, a factor [1]")
    add("--loop", choices=list(LOOPS), help="at the end of the clip: start again, play backwards, or stop [loop]")
    add("--backend", choices=("glfw", "http"), help="glfw: desktop window; http: web server for a browser (pip install "
        "'lapgs-wgpu[remote]') [glfw]")
    add("--host", metavar="ADDRESS", help="with --backend http: address to listen on [127.0.0.1: this machine only]")
    add("--port", type=_within(0, 65535, int), metavar="N", help="with --backend http: TCP port; 0: any free port "
        "[8080]")

    add = parser.add_argument_group("screenshot and video (no window); existing files are replaced").add_argument
    add("--screenshot", metavar="FILE.png", help="render one image")
    add("--video", metavar="FILE.mp4", help="render a video (H.264; pip install 'lapgs-wgpu[video]')")
    add("--path", choices=("time", "view", "both"), help="of --video; time: static camera while the clip plays; "
        "view: one orbit at --time, to and fro where the capture has cameras on one side only; both: the same while "
        "the clip plays [time, or view if the scene does not move]")
    add("--seconds", type=_within(0.001, 86400.0), metavar="S", help="length of --video [that of the clip; 6 for "
        "view]")

    add = parser.add_argument_group("export (no window)").add_argument
    add("--export", metavar="FILE|DIR", help=".ply: static 3DGS file at --time; "
        ".lapgs: compact scene with its motion; .html: web page that plays it; .4dgs: motion as straight lines (pip "
        "install 'lapgs-wgpu[export]'); .usd, .usda, .usdz: OpenUSD with time samples (pip install "
        "'lapgs-wgpu[usd]'); DIR: a static .ply for each of --frames, and their manifest")
    add("--max-error", type=_within(0.01, 100.0), metavar="PX", help="of a .4dgs: how far lines may be off the learned "
        "motion, pixels of the captured images at the focus [0.5]")
    add("--frames", type=_within(1, 100_000, int), metavar="N", help="of DIR and .usd: times, evenly from 0 to 1 "
        "[of .usd: those of the clip, at least 61]")
    add("--overwrite", action="store_const", const=True, help="replace an existing file, or the frame_*.ply in DIR")
    # fmt: on
    arguments = list(arguments)
    if "--up" in arguments[:-1]:  # "-y" alone would be an option to the parser
        at = arguments.index("--up")
        arguments[at : at + 2] = [f"--up={arguments[at + 1]}"]
    return parser.parse_args(arguments)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (min(size) >= 1 and max(size) <= 16384):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, each from 1 to 16384, got {text!r}")
    return size


def _within(low: float, high: float, kind: type = float) -> Callable[[str], Any]:
    def number(text: str) -> Any:
        with suppress(ValueError):
            if low <= (value := kind(text)) <= high:
                return value
        what = "a whole number" if kind is int else "a number"
        raise argparse.ArgumentTypeError(f"expected {what} from {low:g} to {high:g}, got {text!r}")

    return number
