"""The command lapgs-view."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_wgpu.command import guarded, print_devices
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.options import USD, parse_options
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS

if TYPE_CHECKING:
    from lapgs_wgpu.data import View
    from lapgs_wgpu.splat.camera import Camera
    from lapgs_wgpu.viewer.loaded_scene import LoadedScene
    from lapgs_wgpu.viewer.offscreen import OffscreenRenderer
    from lapgs_wgpu.viewer.view_state import ViewState

_SIZE = (1280, 720)  # of a window or picture, where nothing else says it
_WITHOUT_WINDOW = "take --backend http to look in a browser (also from another machine), or --screenshot FILE.png"


def _view(arguments: list[str]) -> None:
    given, job = parse_options(arguments)
    if job == "list_devices":
        print_devices()
        return
    if given.file is None:
        raise InputError("name a file or a folder of frames; lapgs-view --help says more.")
    from lapgs_wgpu.gpu.device import open_device

    with ThreadPoolExecutor(1) as other:
        device = other.submit(open_device, given.device)  # beside all that follows, which takes as long together
        # Before the scene is read, which may take a while: whether there is a place to show it.
        show = _window(given) if job == "window" else partial(_JOBS[job], given)
        from lapgs_wgpu.viewer.loaded_scene import load_scene

        antialiased = None if given.antialiased is None else given.antialiased == "yes"
        scene = load_scene(Path(given.file), device.result, up=given.up, antialiased=antialiased)
    if given.mode == "motion" and not scene.playback.moves:
        raise InputError(f"{scene.path}: does not move; --mode motion shows nothing.")
    show(scene)


def _window(given: Any) -> Callable[[LoadedScene], None]:
    """Start listening for browsers, or check that a window can be opened; returns what shows a scene there."""
    start = partial(_start, given)
    if given.backend == "http":
        from lapgs_wgpu.viewer.remote import listen, run_remote

        host = given.host or "127.0.0.1"
        listening = listen(host, 8080 if given.port is None else given.port)
        return lambda scene: run_remote(scene, listening, host, start)
    from lapgs_wgpu.viewer.window import check_window, run_window

    check_window(_WITHOUT_WINDOW)
    return lambda scene: run_window(scene, given.size or _SIZE, start)


def _start(given: Any, state: ViewState) -> None:
    """Set the state as the options say. Raises InputError where the capture lacks the view."""
    state.mode = given.mode or state.mode
    if given.view is not None:
        state.stand_at(state.scene.view_number(given.view))
    state.background = BACKGROUNDS.get(given.background, state.background)
    state.show_transport = bool(given.time_slider or state.show_transport)
    clock = state.clock
    if given.time is not None:
        clock.seek(given.time)
    clock.fps, clock.speed = given.fps or clock.fps, given.speed or clock.speed
    clock.loop = given.loop or clock.loop
    if given.play:
        clock.toggle()


def _picture(given: Any, scene: LoadedScene) -> tuple[OffscreenRenderer, View | None, tuple[int, int], float]:
    """What draws, the captured view that --view names, and the picture's size and time, given or of that view."""
    from lapgs_wgpu.viewer.offscreen import OffscreenRenderer

    view = scene.views[scene.view_number(given.view)] if given.view is not None else None
    size = given.size or ((view.camera.width, view.camera.height) if view else _SIZE)
    time = given.time if given.time is not None else view.time if view else 0.0
    return OffscreenRenderer(scene, given.mode or "rgb", BACKGROUNDS.get(given.background)), view, size, time


def _camera(scene: LoadedScene, view: View | None, size: tuple[int, int]) -> Camera:
    from lapgs_wgpu.viewer.offscreen import framed

    return framed(view.camera, *size) if view else scene.camera().camera(*size)


def _screenshot(given: Any, scene: LoadedScene) -> None:
    from lapgs_wgpu.data.images import encode_png
    from lapgs_wgpu.io.atomic import atomic_write

    file = _named(given.screenshot, ".png", "--screenshot")
    renderer, view, size, time = _picture(given, scene)
    with atomic_write(file) as target:
        target.write(encode_png(renderer(_camera(scene, view, size), time)))
    print(f"{file}: {size[0]}x{size[1]}, time {time:g}")


def _video(given: Any, scene: LoadedScene) -> None:
    import numpy as np

    from lapgs_wgpu.data.images import size_text
    from lapgs_wgpu.viewer import video
    from lapgs_wgpu.viewer.camera import ViewCamera

    file = _named(given.video, ".mp4", "--video")
    path = given.path or ("time" if scene.playback.moves else "view")
    if path != "view" and given.time is not None:
        raise InputError(f"--time has no use with --path {path}, along which time passes.")
    renderer, view, wanted, time = _picture(given, scene)
    size = max(2, wanted[0] // 2 * 2), max(2, wanted[1] // 2 * 2)  # as the pixel format yuv420p needs it
    if size != wanted:
        print(f"note: mp4 needs even sizes: {size_text(wanted)} becomes {size_text(size)}", file=sys.stderr)
    fps = given.fps or 30.0
    seconds = given.seconds or (6.0 if path == "view" else scene.clock().frames / fps)
    frames = max(1, round(seconds * fps))
    if path == "time":
        camera = _camera(scene, view, size)
        cameras: Iterator[video.TimedCamera] = ((camera, share) for share in np.linspace(0, 1, frames).tolist())
    else:
        first, start = scene.initial_view, view.camera if view else scene.initial_view.camera
        turning = ViewCamera(start, first.focus, first.up)
        cameras = video.orbit_views(turning, size, frames, None if path == "both" else time, first.arc_from(start))
    video.write_video(file, cameras, frames, fps, renderer)
    print(f"{file}: {frames} frames of {size_text(size)} at {fps:g} a second")


def _export(given: Any, scene: LoadedScene) -> None:
    from lapgs_wgpu.viewer import export

    file, overwrite = Path(given.export), bool(given.overwrite)
    ending = file.suffix.lower()
    if ending in (".4dgs", ".lapgs", ".html", ".ply", *USD):
        export.check_free(scene, file, overwrite)
    if ending == ".4dgs":
        from lapgs_wgpu.viewer.export_4dgs import MAX_ERROR, export_4dgs

        loss = export_4dgs(scene, file, given.max_error or MAX_ERROR)
    elif ending in USD:
        from lapgs_wgpu.viewer.export_usd import export_usd

        frames = given.frames or max(61, scene.clock().frames) if scene.playback.moves else 1
        loss = export_usd(scene, file, frames)
    elif ending in (".lapgs", ".html"):
        loss = export.export_compact(scene, file)
    elif ending == ".ply":
        loss = export.export_still(scene, file, given.time or 0.0)
    else:
        loss = export.export_frames(scene, file, given.frames, overwrite=overwrite)
    size = f", {file.stat().st_size / 1e6:.2f} MB" if file.is_file() else ""
    print(f"{file}: {scene.playback.count} Gaussians{size}, {loss.psnr:.1f} dB PSNR against {scene.path}")
    if loss.reason:
        print(f"warning: the loss is seen: {loss.reason}.", file=sys.stderr)


_JOBS = {"screenshot": _screenshot, "video": _video, "export": _export}


def _named(name: str, ending: str, option: str) -> Path:
    if not name.lower().endswith(ending):
        raise InputError(f"{option} {name}: expected a name that ends with {ending}.")
    return Path(name)


view_command = partial(guarded, "lapgs-view", _view)

if __name__ == "__main__":
    sys.exit(view_command())
