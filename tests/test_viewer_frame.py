"""Frames: in full at rest, whatever was drawn while something moved; devices that fail."""

import asyncio
import importlib
import signal
from collections.abc import Callable, Coroutine, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.playback import open_playback
from helpers.still_scenes import CAMERA
from helpers.trained_scenes import GRID4D, OURS, trained

from lapgs_wgpu.errors import DeviceLostError, NumericalError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.playback.torch_playback import TorchPlayback
from lapgs_wgpu.viewer.frame import Frame, FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.options import parse_options
from lapgs_wgpu.viewer.view_state import TrainingControl

pytestmark = pytest.mark.kernels


def planes(frame: Frame) -> np.ndarray:
    return frame.planes.read().view(np.uint32)[:4]


def test_the_first_frame_of_a_mode_is_of_its_own_time(device: Device, tmp_path: Path) -> None:
    trained(device, GRID4D, 100).save(tmp_path / "scene.ply")
    renderer = FrameRenderer(open_playback(tmp_path / "scene.ply", device))
    first, second = (planes(renderer.draw(FrameRequest(CAMERA, 0.3, "motion", (0, 0, 0)))) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def app_by_the_clock(file: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any, list[float]]:
    """A canvas without a window, the viewer on it, and what its clock shows, in seconds: a list of one number."""
    offscreen = pytest.importorskip("rendercanvas.offscreen")
    pytest.importorskip("imgui_bundle")
    from lapgs_wgpu.viewer import app as app_module
    from lapgs_wgpu.viewer import viewport as viewport_module
    from lapgs_wgpu.viewer.loaded_scene import load_scene

    now = [50.0]
    for module in (app_module, viewport_module):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    canvas = offscreen.RenderCanvas(size=(64, 48), pixel_ratio=1)
    loop = SimpleNamespace(call_later=lambda seconds, callback: None)
    return canvas, app_module.App(canvas, loop, load_scene(file, lambda: device)), now


@pytest.mark.triangles
@pytest.mark.parametrize("low_pass", [False, 0.1])
def test_antialiased_is_switched_by_a_key(
    tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch, low_pass: bool | float
) -> None:
    scene = trained(device, GRID4D, 50)
    scene.antialiased = low_pass
    scene.save(tmp_path / "a.ply")
    canvas, app, now = app_by_the_clock(tmp_path / "a.ply", device, monkeypatch)
    pictures = []
    for antialiased in (bool(low_pass), not low_pass):
        assert app.state.antialiased == antialiased
        canvas.draw()
        now[0] += 1
        canvas.draw()
        pictures.append(planes(app.viewport.frame))
        app._on_key_down({"key": "X", "modifiers": []})
    assert np.abs(pictures[0] - pictures[1]).max() > 0


@pytest.mark.triangles
def test_the_window_rests_in_full(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained(device, GRID4D, 100).save(tmp_path / "scene.ply")
    canvas, app, now = app_by_the_clock(tmp_path / "scene.ply", device, monkeypatch)
    exact = FrameRenderer(open_playback(tmp_path / "scene.ply", device))
    canvas.draw()
    monkeypatch.setattr(app.viewport, "_moving_scale", 0.5)
    app.state.clock.seek(0.3)
    now[0] += 0.1
    canvas.draw()
    assert app.viewport.scale == 0.5
    now[0] += 0.1
    canvas.draw()
    assert not app.viewport.at_rest  # it may move on
    now[0] += 0.2
    canvas.draw()
    assert app.viewport.at_rest
    np.testing.assert_array_equal(planes(app.viewport.frame), planes(exact.draw(app.viewport.frame.request)))
    rests = app.viewport.frame
    now[0] += 5
    canvas.draw()
    assert app.viewport.frame is rests


@pytest.mark.triangles
def test_the_window_begins_as_the_options_say(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained(device, GRID4D, 100).save(tmp_path / "scene.ply")
    _, app, _ = app_by_the_clock(tmp_path / "scene.ply", device, monkeypatch)
    words = "a.ply --time 0.2 --speed 0.5 --loop bounce --mode depth --fps 12 --background white"
    app.state.begin(parse_options(words.split())[0])
    state = app.state
    assert (state.clock.time, state.clock.speed, state.clock.loop, state.clock.fps) == (0.2, 0.5, "bounce", 12.0)
    assert (state.mode, state.background, state.clock.playing) == ("depth", (1.0, 1.0, 1.0), False)


@pytest.mark.triangles
def test_a_device_that_fails_ends_the_viewer(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """rendercanvas logs exceptions and goes on. And the clip does not leap where the window could not be drawn."""
    trained(device, GRID4D, 100).save(tmp_path / "scene.ply")
    canvas, app, now = app_by_the_clock(tmp_path / "scene.ply", device, monkeypatch)
    app.state.clock.playing = True
    canvas.draw()
    begun = app.state.clock.time
    now[0] += 30
    canvas.draw()
    assert 0 < app.state.clock.time - begun <= 0.25 / app.state.clock.seconds + 1e-6
    imgui = importlib.import_module("imgui_bundle").imgui
    canvas.submit_event({"event_type": "pointer_down", "button": 1, "buttons": (1,), "x": 21, "y": 13})
    canvas._events.flush()
    for _ in range(2):
        canvas.draw()
    assert tuple(imgui.get_mouse_pos()) == (21, 13)  # of a finger, which comes without a move
    ended: list[None] = []
    app.end = lambda: ended.append(None)

    def give_out(*_: object, **__: object) -> None:
        raise DeviceLostError("the device is gone")

    monkeypatch.setattr(app.viewport, "draw", give_out)
    canvas.draw()
    assert str(app.failed) == "the device is gone"
    assert ended == [None]


def test_the_values_of_a_training_are_those_after_its_last_step(device: Device) -> None:
    """Also where the frame is drawn since the camera moves, and not since `refresh` was called."""
    offscreen = pytest.importorskip("rendercanvas.offscreen")
    from lapgs_wgpu.viewer.view_state import ViewState
    from lapgs_wgpu.viewer.viewport import Viewport

    scene = trained(device, OURS, 60)
    look = InitialView(CAMERA, np.zeros(3), np.array([0.0, 0, 1]), 9)
    state = ViewState(LoadedScene(None, TorchPlayback(scene), look))
    state.mode, state.training = "motion", TrainingControl()
    viewport = Viewport(offscreen.RenderCanvas(size=(64, 48), pixel_ratio=1), state)
    viewport.draw(50.0)
    with torch.no_grad():  # a step that reorders the Gaussians
        for parameter in scene.parameters.values():
            parameter.copy_(parameter.flip(0))
    state.training.last = SimpleNamespace(step=1, steps=9, psnr=20.0)
    state.camera.orbit(0.2, 0.0)
    viewport.draw(51.0)
    assert viewport.frame is not None
    fresh = FrameRenderer(TorchPlayback(scene)).draw(viewport.frame.request)
    np.testing.assert_array_equal(planes(viewport.frame), planes(fresh))


def test_an_error_of_a_watched_step_reaches_the_caller(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    offscreen = pytest.importorskip("rendercanvas.offscreen")
    from lapgs_wgpu.viewer import live

    tasks: list[Callable[[], Coroutine[Any, Any, None]]] = []

    def run() -> None:
        for task in tasks:
            with suppress(Exception):  # as rendercanvas logs it
                asyncio.run(task())

    def steps() -> Iterator[Any]:
        yield SimpleNamespace(step=1, steps=9, psnr=20.0)
        raise NumericalError("step 2: the loss is nan.")

    canvas = offscreen.RenderCanvas(size=(64, 48), pixel_ratio=1)
    loop = SimpleNamespace(add_task=tasks.append, run=run, call_later=lambda seconds, callback: None)
    monkeypatch.setattr(live.window, "make_canvas", lambda *_: (canvas, loop))
    interrupt = signal.getsignal(signal.SIGINT)
    try:
        initial_view = InitialView(CAMERA, np.zeros(3), np.array([0.0, 0, 1]), 9)
        with pytest.raises(NumericalError, match="the loss is nan"):
            live.watch(Path("checkpoint.ply"), trained(device, GRID4D, 20), initial_view, steps())
    finally:
        signal.signal(signal.SIGINT, interrupt)
    assert canvas.get_closed()
