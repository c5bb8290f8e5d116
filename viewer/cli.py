"""The command lapgs-view."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_wgpu.command import guarded, print_devices
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.options import NEW_TOKEN, parse_options
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS

if TYPE_CHECKING:
    from lapgs_wgpu.gpu.device import Device
    from lapgs_wgpu.viewer.loaded_scene import LoadedScene

_WINDOW_SIZE = (1280, 720)


def view_command(arguments: Sequence[str] | None = None) -> int:
    """lapgs-view: returns the exit code."""
    return guarded("lapgs-view", _view, list(sys.argv[1:] if arguments is None else arguments))


def _view(arguments: list[str]) -> None:
    given, job = parse_options(arguments)
    if job == "list_devices":
        print_devices()
        return
    if given.file is None:
        raise InputError("name a .ply or .lapgs file; lapgs-view --help says more.")
    with ThreadPoolExecutor(1) as other:
        # Beside all that follows: the driver and its compiler take longer than the rest together.
        device = other.submit(_warm_device, given.device)
        # Before the scene is read, which may take a while: whether there is a place to show it.
        place = _place(given) if job == "window" else None
        from lapgs_wgpu.viewer.loaded_scene import load_scene

        scene = load_scene(Path(given.file), device.result)
    if not scene.playback.moves:
        for name in ("time", "play", "frames", "speed", "loop", *(("fps",) if place is not None else ())):
            if getattr(given, name) is not None:
                raise InputError(f"{given.file} holds no motion, so --{name} has no use.")
    if place is not None:
        _window(given, scene, place)
    else:
        {"screenshot": _screenshot, "video": _video, "export": _export}[job](given, scene)


def _warm_device(name: str | None) -> Device:
    from lapgs_wgpu.gpu.device import open_device
    from lapgs_wgpu.viewer.frame import warm_up

    device = open_device(name)
    warm_up(device)
    return device


def _place(given: Any) -> Any:
    """Where it is shown: the name of a window's backend, or where browsers come in, already listening."""
    if given.backend != "http":
        for option in ("host", "port", "token"):
            if getattr(given, option) is not None:
                raise InputError(f"--{option} goes with --backend http.")
        from lapgs_wgpu.viewer.window import choose_backend

        return choose_backend(given.backend or "auto")
    if given.size is not None:
        raise InputError("--size has no use with --backend http: the picture has the size of the browser's window.")
    from lapgs_wgpu.viewer.auth import new_token
    from lapgs_wgpu.viewer.remote import DEFAULT_HOST, DEFAULT_PORT, open_entry

    port = DEFAULT_PORT if given.port is None else given.port
    token = new_token() if given.token == NEW_TOKEN else given.token
    return open_entry(given.host or DEFAULT_HOST, port, token)


def _window(given: Any, scene: LoadedScene, place: Any) -> None:
    from lapgs_wgpu.viewer.initial_state import InitialState

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
        from lapgs_wgpu.viewer.window import run_window

        size = given.size or _WINDOW_SIZE
        run_window(scene, backend=place, size=size, transport=given.time_slider, start=start)
    else:
        from lapgs_wgpu.viewer.remote import run_remote

        run_remote(scene, place, transport=given.time_slider, start=start)


def _screenshot(given: Any, scene: LoadedScene) -> None:
    from lapgs_wgpu.viewer.offscreen import OffscreenRenderer, find_view, framed, write_png

    file = _named(given.screenshot, ".png", "--screenshot")
    view = find_view(scene, given.view) if given.view is not None else None
    if view is not None:
        camera = framed(view.camera, *given.size) if given.size else view.camera
    else:
        camera = scene.camera().camera(*(given.size or _WINDOW_SIZE))
    render = OffscreenRenderer(scene, given.mode or "rgb", BACKGROUNDS.get(given.background))
    time = given.time if given.time is not None else view.time if view is not None else 0.0
    write_png(file, render(camera, time))
    print(f"{file}: {camera.width}x{camera.height}, time {time:g}")


def _video(given: Any, scene: LoadedScene) -> None:
    from lapgs_wgpu.viewer import video
    from lapgs_wgpu.viewer.camera import ViewCamera
    from lapgs_wgpu.viewer.offscreen import OffscreenRenderer, find_view, framed
    from lapgs_wgpu.viewer.path_file import read_path

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
        cameras = video.path_views(held.path, size, frames)
    elif path == "time":
        camera = framed(view.camera, *size) if view else scene.camera().camera(*size)
        cameras = video.clip_views(camera, frames)
    else:
        start, arc = scene.camera(), scene.look.arc
        if view is not None:
            start = ViewCamera.of(view.camera, scene.look.focus, scene.look.up)
            arc = scene.look.arc_from(view.camera)
        usual_time = view.time if view is not None else 0.0
        time = None if path == "both" else usual_time if given.time is None else given.time
        cameras = video.orbit_views(start, size, frames, time, arc)
    render = OffscreenRenderer(scene, given.mode or "rgb", BACKGROUNDS.get(given.background))
    video.write_video(file, cameras, frames, fps, render)
    print(f"{file}: {frames} frames of {size[0]}x{size[1]} at {fps:g} a second")


def _export(given: Any, scene: LoadedScene) -> None:
    _write_export(given, scene)
    ours = Path(given.export).suffix.lower() in (".lapgs", ".html")
    if not ours and scene.playback.at(0.0).antialiased:
        print(
            "note: the scene was trained antialiased, which a file for other viewers cannot say: where they offer "
            "antialiased drawing, turn it on; elsewhere thin places look a little thicker.",
            file=sys.stderr,
        )


def _write_export(given: Any, scene: LoadedScene) -> None:
    from lapgs_wgpu.viewer.export import export_compact, export_frames, export_still

    overwrite = bool(given.overwrite)
    ending = Path(given.export).suffix.lower()
    if given.max_error is not None and ending != ".4dgs":
        raise InputError(f"--max-error has no use with --export {given.export}: only a .4dgs file needs it.")
    if ending in (".lapgs", ".html", ".4dgs"):
        for name in ("time", "frames"):
            if getattr(given, name) is not None:
                raise InputError(f"--{name} has no use with --export {given.export}, which holds the whole clip.")
        file = Path(given.export)
        if ending == ".4dgs":
            from lapgs_wgpu.viewer.export_4dgs import MAX_ERROR, export_4dgs

            baked = export_4dgs(scene, file, given.max_error or MAX_ERROR, overwrite=overwrite)
            print(
                f"{file}: {baked.gaussians} Gaussians as {baked.pieces} pieces, at most {baked.error:.2f} pixels of "
                f"the captured images from the learned motion, {file.stat().st_size / 1e6:.2f} MB"
            )
            return
        export_compact(scene, file, overwrite=overwrite)
        print(f"{file}: {scene.playback.count} Gaussians, {file.stat().st_size / 1e6:.2f} MB")
        return
    if given.frames is None:
        more = ", .lapgs, .html or .4dgs; a sequence of frames in a folder needs --frames"
        file = _named(given.export, ".ply", "--export", more)
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


if __name__ == "__main__":
    sys.exit(view_command())
