"""The options of lapgs-view, and which of them go together."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import Any

from lapgs_wgpu.command import DEVICE_HELP, LIST_DEVICES_HELP, HelpFormatter, Parser
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.clock import LOOPS
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS, MODES

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
  lapgs-view CHECKPOINT.ply --video a.mp4 --path CAMERAS.json         along a camera path (nerfstudio's format)
  lapgs-view CHECKPOINT.ply --export still.ply --time 0.5             static .ply for other splat viewers
  lapgs-view CHECKPOINT.ply --export frames --frames 60               sequence of static .ply files for SuperSplat
  lapgs-view CHECKPOINT.ply --export scene.html                       web page that plays the scene on the visitor's GPU
  lapgs-view CHECKPOINT.ply --export scene.lapgs                      compact scene for such a page, or for lapgs-view
  lapgs-view CHECKPOINT.ply --export scene.4dgs                       motion as straight lines, for players of .4dgs

[Values in brackets] are defaults.
"""

# Job -> the options that it takes; every job but window is chosen by the option of its name.
_COMMON = {"device"}
_PICTURE = _COMMON | {"time", "mode", "background", "size", "view"}
_TAKES = {
    "list_devices": set[str](),
    "screenshot": _PICTURE,
    "video": _PICTURE | {"path", "fps", "seconds"},
    "export": _COMMON | {"time", "frames", "max_error", "overwrite"},
    "window": _PICTURE | {"time_slider", "play", "fps", "speed", "loop", "backend", "host", "port"},
}


def parse_options(arguments: Sequence[str]) -> tuple[Any, str]:
    """The options, None where not given, and the job: one of _TAKES. Raises InputError where options conflict."""
    given = _parse(arguments)
    return given, _job(given)


def _job(given: Any) -> str:
    """What is to be done. Raises InputError for options that do not go together: none is silently ignored."""
    jobs = [name for name in _TAKES if getattr(given, name, None) is not None]
    if len(jobs) > 1:
        raise InputError(f"{_option(jobs[0])} and {_option(jobs[1])} do not go together: one at a time.")
    job = jobs[0] if jobs else "window"
    for name, value in vars(given).items():
        if value is not None and name not in ("file", job) and name not in _TAKES[job]:
            place = f"with {_option(job)}" if job != "window" else "in a window"
            raise InputError(f"{_option(name)} has no use {place}.")
    return job


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _parse(arguments: Sequence[str]) -> Any:
    parser = Parser("lapgs-view", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    # fmt: off
    add = parser.add_argument
    # All defaults are None, which tells given options from others.
    add("file", nargs="?", metavar="FILE.ply", help="checkpoint, compact scene (.lapgs), or any 3DGS .ply file")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--list-devices", action="store_const", const=True, help=LIST_DEVICES_HELP)

    add = parser.add_argument_group("content of the window, screenshot or video").add_argument
    add("--time", type=_number(0.0, 1.0), metavar="T", help="time in the clip, from 0 to 1; also of --export FILE.ply; "
        "not for videos in which the clip plays [0, or the time of --view]")
    add("--mode", choices=list(MODES), help="; ".join(f"{mode}: {about}" for mode, about in MODES.items()) + " [rgb]")
    add("--background", choices=list(BACKGROUNDS), help="color behind the Gaussians [the training's, otherwise black]")
    add("--size", type=_size, metavar="WxH", help="pixels [1280x720, or of a picture that of --view or of the camera "
        "path]")
    add("--view", metavar="N|NAME", help="camera of the capture by name or number; test views come first [where the "
        "file says, otherwise one that shows the whole scene]")

    add = parser.add_argument_group("window").add_argument
    add("--time-slider", action="store_const", const=True, help="show the time slider [shown if the scene moves]")
    add("--play", action="store_const", const=True, help="start playing at once [paused]")
    add("--fps", type=_number(0.1, 1000.0), metavar="F", help="frames a second at speed 1 and of --video "
        "[30, or that of the camera path]")
    add("--speed", type=_number(0.01, 100.0), metavar="X", help="playback speed, a factor [1]")
    add("--loop", choices=list(LOOPS), help="at the end of the clip: start again, play backwards, or stop [loop]")
    add("--backend", choices=("glfw", "http"), help="glfw: desktop window; http: web server for a browser (pip install "
        "'lapgs-wgpu[remote]') [glfw]")
    add("--host", metavar="ADDRESS", help="with --backend http: address to listen on [127.0.0.1: this machine only]")
    add("--port", type=_port, metavar="N", help="with --backend http: TCP port; 0: any free port [8080]")

    add = parser.add_argument_group("screenshot and video (no window); existing files are replaced").add_argument
    add("--screenshot", metavar="FILE.png", help="render one image")
    add("--video", metavar="FILE.mp4", help="render a video (H.264; pip install 'lapgs-wgpu[video]')")
    add("--path", metavar="time|view|both|CAMERAS.json", help="of --video; time: static camera while the clip plays; "
        "view: one orbit at --time, to and fro where the capture has cameras on one side only; both: the same while "
        "the clip plays; CAMERAS.json: camera path in nerfstudio's format [time, or view if the scene does not move]")
    add("--seconds", type=_number(0.001, 86400.0), metavar="S", help="length of --video [that of the clip or of the "
        "camera path; 6 for view]")

    add = parser.add_argument_group("export (no window)").add_argument
    add("--export", metavar="FILE.ply|.lapgs|.html|.4dgs|DIR", help=".ply: static 3DGS file at --time; "
        ".lapgs: compact scene with its motion; .html: web page that plays it; .4dgs: motion as straight lines (pip "
        "install 'lapgs-wgpu[export]'); DIR: a static file for each of --frames")
    add("--max-error", type=_number(0.01, 100.0), metavar="PX", help="of a .4dgs: how far lines may be off the learned "
        "motion, pixels of the captured images at the focus [0.5]")
    add("--frames", type=_count, metavar="N", help="number of files in DIR, at times evenly from 0 to 1")
    add("--overwrite", action="store_const", const=True, help="replace an existing file, or the frame_*.ply in DIR")
    # fmt: on
    return parser.parse_args(arguments)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 65535, got {text!r}")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None or not (0 < int(found[1]) <= 16384 and 0 < int(found[2]) <= 16384):
        raise argparse.ArgumentTypeError(
            f"expected WIDTHxHEIGHT in pixels, such as 1280x720, each at most 16384, got {text!r}"
        )
    return int(found[1]), int(found[2])


def _number(low: float, high: float) -> Callable[[str], float]:
    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected a number from {low:g} to {high:g}, got {text!r}")
        return value

    return number


def _count(text: str) -> int:
    from lapgs_wgpu.viewer.export import MOST_FRAMES

    if re.fullmatch(r"\d{1,9}", text) is None or not 1 <= int(text) <= MOST_FRAMES:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to {MOST_FRAMES}, got {text!r}")
    return int(text)
