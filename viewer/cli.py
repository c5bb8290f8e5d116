"""lapgs-view: the command."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_wgpu.command import HelpFormatter, Parser, guarded, print_devices
from lapgs_wgpu.errors import InputError

from .clock import LOOPS
from .render_modes import BACKGROUNDS, MODES

if TYPE_CHECKING:
    from lapgs_wgpu.gpu.device import Device

    from .loaded_scene import LoadedScene

DESCRIPTION = """\
Look at a trained scene, or any 3DGS .ply, at any time from any side.

  lapgs-view runs/demo/checkpoint.ply --time-slider
  lapgs-view runs/demo/checkpoint.ply --play --speed 0.5 --loop bounce
  lapgs-view runs/demo/checkpoint.ply --backend http                  in a browser, also from another machine

Without a screen:
  lapgs-view CHECKPOINT.ply --screenshot a.png --time 0.5 --size 1920x1080
  lapgs-view CHECKPOINT.ply --screenshot a.png --view test_000 --mode depth
  lapgs-view CHECKPOINT.ply --video a.mp4                             the clip once; a still scene once around
  lapgs-view CHECKPOINT.ply --video a.mp4 --path both --seconds 10    the clip while the camera goes once around
  lapgs-view CHECKPOINT.ply --video a.mp4 --path CAMERAS.json         along a camera path (nerfstudio's format)
  lapgs-view CHECKPOINT.ply --export still.ply --time 0.5             for any other splat viewer
  lapgs-view CHECKPOINT.ply --export frames --frames 60               a sequence of stills, as SuperSplat plays it
"""

# What is done, and the options that it takes; each of these jobs is asked for by the option of its name.
_COMMON = {"device"}
_PICTURE = _COMMON | {"time", "mode", "background", "size", "view"}
_TAKES = {
    "list_devices": set[str](),
    "screenshot": _PICTURE,
    "video": _PICTURE | {"path", "fps", "seconds"},
    "export": _COMMON | {"time", "frames", "overwrite"},
    "window": _PICTURE | {"time_slider", "play", "fps", "speed", "loop", "backend", "host", "port", "token"},
}
_WINDOW_SIZE = (1280, 720)
NEW_TOKEN = ""  # what --token without a text stands for


def view_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-view: returns the exit code."""
    return guarded("lapgs-view", _view, list(sys.argv[1:] if arguments is None else arguments))


def _view(arguments: list[str]) -> None:
    given = _parse(arguments)
    job = _job(given)
    if job == "list_devices":
        print_devices()
        return
    if given.file is None:
        raise InputError("name a .ply file; lapgs-view --help says more.")
    with ThreadPoolExecutor(1) as other:
        # Beside all that follows: the driver and its compiler take longer than the rest together.
        device = other.submit(_warm_device, given.device)
        # Before the scene is read, which may take a while: whether there is a place to show it.
        place = _place(given) if job == "window" else None
        from .loaded_scene import load_scene

        scene = load_scene(Path(given.file), device.result)
    if not scene.playback.moves:
        for name in ("time", "play", "frames"):
            if getattr(given, name) is not None:
                raise InputError(f"{given.file} holds no motion, so --{name} has no use.")
    if place is not None:
        _window(given, scene, place)
    else:
        {"screenshot": _screenshot, "video": _video, "export": _export}[job](given, scene)


def _warm_device(name: str | None) -> Device:
    from lapgs_wgpu.gpu.device import open_device

    from .frame import warm_up

    device = open_device(name)
    warm_up(device)
    return device


def _place(given: Any) -> Any:
    """Where it is shown: the name of a window's backend, or where browsers come in, already listening."""
    if given.backend != "http":
        for option in ("host", "port", "token"):
            if getattr(given, option) is not None:
                raise InputError(f"--{option} goes with --backend http.")
        from .window import choose_backend

        return choose_backend(given.backend or "auto")
    if given.size is not None:
        raise InputError("--size has no use with --backend http: the picture has the size of the browser's window.")
    from .auth import new_token
    from .remote import DEFAULT_HOST, DEFAULT_PORT, open_entry

    port = DEFAULT_PORT if given.port is None else given.port
    token = new_token() if given.token == NEW_TOKEN else given.token
    return open_entry(given.host or DEFAULT_HOST, port, token)


def _window(given: Any, scene: LoadedScene, place: Any) -> None:
    from .initial_state import InitialState

    start = InitialState(
        time=given.time,
        play=bool(given.play),
        fps=given.fps,
        speed=given.speed,
        loop=given.loop,
        mode=given.mode,
        background=BACKGROUNDS.get(given.background),
        view=given.view,
    )
    if isinstance(place, str):
        from .window import run_window

        size = given.size or _WINDOW_SIZE
        run_window(scene, backend=place, size=size, transport=given.time_slider, start=start)
    else:
        from .remote import run_remote

        run_remote(scene, place, transport=given.time_slider, start=start)


def _screenshot(given: Any, scene: LoadedScene) -> None:
    from .offscreen import OffscreenRenderer, find_view, framed, write_png

    file = _named(given.screenshot, ".png", "--screenshot")
    view = find_view(scene, given.view) if given.view is not None else None
    if view is not None:
        camera = framed(view.camera, *given.size) if given.size else view.camera
    else:
        camera = scene.camera().camera(*(given.size or _WINDOW_SIZE))
    shoot = OffscreenRenderer(scene, given.mode or "rgb", BACKGROUNDS.get(given.background))
    time = given.time if given.time is not None else view.time if view is not None else 0.0
    write_png(file, shoot(camera, time))
    print(f"{file}: {camera.width}x{camera.height}, time {time:g}")


def _video(given: Any, scene: LoadedScene) -> None:
    from . import video
    from .camera import ViewCamera
    from .offscreen import OffscreenRenderer, find_view, framed
    from .path_file import read_path

    file = _named(given.video, ".mp4", "--video")
    moves = scene.playback.moves
    path = given.path or ("time" if moves else "view")
    if path not in video.PATHS and not path.endswith(".json"):
        raise InputError(f"--path {path}: expected time, view, both, or the .json file of a camera path.")
    if path != "view" and given.time is not None:
        raise InputError(f"--time has no use with --path {path}, along which time passes.")
    if path in ("time", "both") and not moves:
        raise InputError(f"{given.file} holds no motion, so --path {path} has no use; --path view goes around it.")
    view = find_view(scene, given.view) if given.view is not None else None
    held = None if path in video.PATHS else read_path(Path(path))
    if held is not None and view is not None:
        raise InputError("--view has no use with a camera path, which says where the camera is.")

    size = given.size or (held.size if held else (view.camera.width, view.camera.height) if view else _WINDOW_SIZE)
    if video.even(size) != size:
        print(f"note: mp4 needs even sizes: {size[0]}x{size[1]} becomes {video.even(size)[0]}x{video.even(size)[1]}",
              file=sys.stderr)  # fmt: skip
        size = video.even(size)
    fps = given.fps or (held.fps if held else 30.0)
    usual = held.path.seconds if held else scene.clock().frames / fps if moves and path != "view" else 6.0
    frames = video.count_frames(given.seconds or usual, fps)

    if held is not None:
        shots = video.path_shots(held.path, size, frames)
    elif path == "time":
        camera = framed(view.camera, *size) if view else scene.camera().camera(*size)
        shots = video.clip_shots(camera, frames)
    else:
        start = scene.camera()
        if view is not None:
            start = ViewCamera.of(view.camera, scene.look.focus, scene.look.up)
        usual_time = view.time if view is not None else 0.0
        time = None if path == "both" else usual_time if given.time is None else given.time
        shots = video.turn_shots(start, size, frames, time)
    shoot = OffscreenRenderer(scene, given.mode or "rgb", BACKGROUNDS.get(given.background))
    video.write_video(file, shots, frames, fps, shoot)
    print(f"{file}: {frames} frames of {size[0]}x{size[1]} at {fps:g} a second")


def _export(given: Any, scene: LoadedScene) -> None:
    from .export import export_frames, export_still

    overwrite = bool(given.overwrite)
    if given.frames is None:
        file = _named(given.export, ".ply", "--export", "; a sequence of frames in a folder needs --frames")
        export_still(scene, file, given.time or 0.0, overwrite=overwrite)
        print(f"{file}: {scene.playback.count} Gaussians at time {given.time or 0.0:g}")
        return
    if given.time is not None:
        raise InputError("--time has no use with --frames, which go from the start to the end of the clip.")
    if given.export.lower().endswith(".ply"):
        raise InputError(f"--export {given.export}: --frames need the name of a folder, not of a .ply file.")
    export_frames(scene, Path(given.export), given.frames, overwrite=overwrite)
    print(f"{given.export}: {given.frames} frames of {scene.playback.count} Gaussians")


def _named(name: str, ending: str, option: str, more: str = "") -> Path:
    if not name.lower().endswith(ending):
        raise InputError(f"{option} {name}: expected a name that ends with {ending}{more}.")
    return Path(name)


def _job(given: Any) -> str:
    """What is to be done. Raises InputError for options that do not go together: none is silently ignored."""
    jobs = [name for name in _TAKES if getattr(given, name, None) is not None]
    if len(jobs) > 1:
        raise InputError(f"{_option(jobs[0])} and {_option(jobs[1])} do not go together: one at a time.")
    job = jobs[0] if jobs else "window"
    for name, value in vars(given).items():
        if value is None or name in ("file", job) or name in _TAKES[job]:
            continue
        needs = [_option(other) for other, takes in _TAKES.items() if name in takes and other != "window"]
        if job != "window":
            raise InputError(f"{_option(name)} has no use with {_option(job)}.")
        raise InputError(f"{_option(name)} has no use without {' or '.join(needs)}.")
    return job


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _parse(arguments: list[str]) -> Any:
    parser = Parser("lapgs-view", description=DESCRIPTION, formatter_class=HelpFormatter, allow_abbrev=False)
    add = parser.add_argument
    # Every default is None: what was given is told from what was not.
    add("file", nargs="?", metavar="FILE.ply", help="a checkpoint, or any 3DGS .ply")
    add("--device", metavar="NAME", help="part of an adapter's name, or cpu, integrated, discrete")
    add("--list-devices", action="store_const", const=True, help="list the adapters, the default one first")

    add = parser.add_argument_group("what is shown, in the window or in pictures").add_argument
    add("--time", type=_number(0.0, 1.0), metavar="T", help="in the clip, 0 to 1 [0, or that of --view]")
    add("--mode", choices=list(MODES), help="; ".join(f"{mode}: {about}" for mode, about in MODES.items()) + " [rgb]")
    add("--background", choices=list(BACKGROUNDS), help="[the one of the training]")
    add("--size", type=_size, metavar="WxH", help="of the picture [1280x720, or that of --view or the camera path]")
    add("--view", metavar="N|NAME", help="a camera of the capture that the run was trained on, the held-out ones first")

    add = parser.add_argument_group("window").add_argument
    add("--time-slider", action=argparse.BooleanOptionalAction, help="show the time slider [where the scene moves]")
    add("--play", action="store_const", const=True, help="play the clip from the start")
    add("--fps", type=_number(0.1, 1000.0), metavar="F", help="frames a second of the clip, or of --video [30]")
    add("--speed", type=_number(0.01, 100.0), metavar="X", help="of playing [1]")
    add("--loop", choices=list(LOOPS), help="at the end of the clip [loop]")

    add(
        "--backend", choices=("auto", "glfw", "qt", "http"),
        help="what shows it: a window (auto: glfw, else qt), or with http any browser [auto]",
    )  # fmt: skip

    add = parser.add_argument_group("with --backend http").add_argument
    add("--host", metavar="ADDRESS", help="to listen on; any but this machine's own needs --token [127.0.0.1]")
    add("--port", type=_port, metavar="N", help="0: any that is free [8080]")
    add(
        "--token", nargs="?", const=NEW_TOKEN, metavar="TEXT",
        help="what a browser must know to come in, 16 characters or more; one is made where no TEXT is given",
    )  # fmt: skip

    add = parser.add_argument_group("pictures and videos").add_argument
    add("--screenshot", metavar="FILE.png", help="write a picture")
    add("--video", metavar="FILE.mp4", help="write a video (H.264)")
    add(
        "--path", metavar="time|view|both|CAMERAS.json",
        help="of --video: the clip with a camera that stands; once around the focus while time stands; both at once; "
        "or along a camera path [time; view where nothing moves]",
    )  # fmt: skip
    add("--seconds", type=_number(0.001, 86400.0), metavar="S", help="length of --video [that of the clip or the path; "
        "6 for view]")  # fmt: skip

    add = parser.add_argument_group("export").add_argument
    add("--export", metavar="FILE.ply|DIR", help="write the Gaussians at --time, or --frames of them into a folder")
    add("--frames", type=_count, metavar="N", help="how many stills --export writes, from time 0 to 1")
    add("--overwrite", action="store_const", const=True, help="let --export replace what is there")
    return parser.parse_args(arguments)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 65535, got {text!r}")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None or not (0 < int(found[1]) <= 16384 and 0 < int(found[2]) <= 16384):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, such as 1280x720, got {text!r}")
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
    from .export import MOST_FRAMES

    if re.fullmatch(r"\d{1,9}", text) is None or not 1 <= int(text) <= MOST_FRAMES:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to {MOST_FRAMES}, got {text!r}")
    return int(text)


if __name__ == "__main__":
    sys.exit(view_command())
