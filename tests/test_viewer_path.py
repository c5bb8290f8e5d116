"""Camera paths: through their key-frames, smoothly; nerfstudio's files; files that lie; the editor."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.camera_paths import IDENTITY, keys, nerfstudio
from scipy.spatial.transform import Rotation

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.viewer.camera import ViewCamera
from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose
from lapgs_wgpu.viewer.path_editor import PathEditor
from lapgs_wgpu.viewer.path_file import PathFile, read_path, write_path


def assert_near(a: Pose, b: Pose, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(a.position, b.position, atol=atol)
    np.testing.assert_allclose(a.rotation, b.rotation, atol=atol)
    assert a.fov_y == pytest.approx(b.fov_y, abs=atol)


@pytest.mark.parametrize("seed", range(2))
def test_it_passes_through_its_keys_without_a_jump_of_speed(seed: int) -> None:
    path = CameraPath(keys(seed))
    e = 1e-5
    for key in path.keys:
        pose, time = path.at(key.second)
        assert_near(pose, key.pose)
        assert time == pytest.approx(key.time)
    for key in path.keys[1:-1]:
        before, at, after = (path.at(key.second + step)[0] for step in (-e, 0, e))
        for name in ("position", "rotation", "fov_y"):
            a, b, c = (getattr(pose, name) for pose in (before, at, after))
            np.testing.assert_allclose((c - b) / e, (b - a) / e, atol=2e-3, err_msg=name)


def test_rotations_stay_rotations_and_go_the_short_way() -> None:
    def turned(degrees: float) -> np.ndarray:
        return Rotation.from_euler("y", degrees, degrees=True).as_matrix()

    pose = Pose(np.zeros(3), turned(170), 0.7)
    path = CameraPath([KeyFrame(0, 0, pose), KeyFrame(2, 1, pose._replace(rotation=turned(-170)))])
    np.testing.assert_allclose(path.at(1.0)[0].rotation, turned(180), atol=1e-9)
    path = CameraPath(keys(3))
    for second in np.linspace(0, 4, 40):
        rotation = path.at(float(second))[0].rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_velocity_at_a_key_is_that_of_the_parabola_through_its_neighbours() -> None:
    def key(second: float) -> KeyFrame:
        return KeyFrame(second, 0, Pose(np.array([second**2, second, 0.0]), np.eye(3), 0.7))

    path, e = CameraPath([key(0), key(1), key(3)]), 1e-5
    velocity = (path.at(1 + e)[0].position - path.at(1 - e)[0].position) / (2 * e)
    np.testing.assert_allclose(velocity, [2, 1, 0], atol=1e-3)


def test_times_are_linear_between_keys() -> None:
    path = CameraPath(keys())
    assert path.at(1.25)[1] == pytest.approx(0.5)
    times = [path.at(second)[1] for second in np.linspace(0, 4, 200)]
    assert (np.diff(times) > 0).all()


def test_between_equal_keys_it_rests() -> None:
    some = keys()
    some[2] = some[1]._replace(second=1.5)
    path = CameraPath(some)
    for second in np.linspace(1.0, 1.5, 7):
        assert_near(path.at(float(second))[0], some[1].pose)


def test_fields_of_view_stay_within_those_of_the_keys() -> None:
    some = [key._replace(pose=key.pose._replace(fov_y=f)) for key, f in zip(keys(), [0.3, 1.5, 1.4, 0.3], strict=True)]
    path = CameraPath(some)
    found = [path.at(second)[0].fov_y for second in np.linspace(0, 4, 400)]
    assert min(found) >= 0.3 - 1e-12
    assert max(found) <= 1.5 + 1e-12


# Files


def test_what_is_written_is_nerfstudios_and_read_back(tmp_path: Path) -> None:
    """Every key that nerfstudio's render command reads, in its axes and units."""
    camera = ViewCamera([0, 0, 5], [0, 0, 0], [0, 1, 0], math.radians(50))  # looks along -z, as OpenGL's cameras do
    pose = Pose(camera.position, camera.rotation, camera.fov_y)
    path = CameraPath([KeyFrame(0, 0.25, pose), KeyFrame(2, 0.75, pose._replace(position=np.array([1.0, 0, 5])))])
    write_path(tmp_path / "a.json", PathFile(path, (640, 360), 10.0))
    values = json.loads((tmp_path / "a.json").read_text())
    assert values["camera_type"] == "perspective"
    assert (values["render_width"], values["render_height"]) == (640, 360)
    assert (values["fps"], values["seconds"]) == (10.0, 2.0)
    assert len(values["camera_path"]) == 21
    frame = values["camera_path"][10]
    np.testing.assert_allclose(frame["camera_to_world"], [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 5, 0, 0, 0, 1], atol=1e-12)
    assert frame["fov"] == pytest.approx(50)
    assert frame["aspect"] == pytest.approx(640 / 360)
    assert frame["render_time"] == pytest.approx(0.5)
    back = read_path(tmp_path / "a.json")
    assert (back.size, back.fps, back.path.seconds) == ((640, 360), 10.0, 2.0)
    for second in np.linspace(0, 2, 21).tolist():
        (a, t), (b, u) = back.path.at(second), path.at(second)
        assert t == pytest.approx(u)
        assert_near(a, b)


def read(tmp_path: Path, values: Any) -> PathFile:
    (tmp_path / "a.json").write_text(json.dumps(values))
    return read_path(tmp_path / "a.json")


def test_nerfstudios_frames(tmp_path: Path) -> None:
    held = read(tmp_path, nerfstudio())
    assert [key.second for key in held.path.keys] == pytest.approx([0.0, 1 / 30])
    assert [key.time for key in held.path.keys] == [0.0, 1.0]  # the clip once along the path
    first = held.path.keys[0].pose
    np.testing.assert_allclose(first.rotation, np.diag([1, -1, -1]), atol=1e-12)
    assert first.fov_y == pytest.approx(math.radians(60))
    np.testing.assert_allclose(held.path.keys[1].pose.position, [3, 0, 0])
    rows = [{"camera_to_world": IDENTITY, "fov": 50, name: t} for name, t in (("time", 0.5), ("render_time", 0.25))]
    held = read(tmp_path, {"camera_path": rows, "render_width": 64, "render_height": 48})
    assert [key.time for key in held.path.keys] == [0.5, 0.25]


def changed(key: str, value: Any) -> dict[str, Any]:
    values = nerfstudio()
    values["camera_path"][1][key] = value
    return values


BAD: dict[str, tuple[Any, str]] = {
    "a list": ([], "a.json"),
    "fisheye": (nerfstudio(camera_type="fisheye"), "camera_type"),
    "no width": (nerfstudio(render_width=None), "render_width"),
    "endless": (nerfstudio(fps=float("inf")), "fps"),
    "nothing": (nerfstudio(camera_path=[]), "camera_path"),
    "a frame of no object": (nerfstudio(camera_path=[1]), "frame 0"),
    "12 numbers": (changed("camera_to_world", IDENTITY[:12]), "frame 1: camera_to_world"),
    "sheared": (changed("camera_to_world", [1, 1, *IDENTITY[2:]]), "frame 1: camera_to_world"),
    "mirrored": (changed("camera_to_world", [-1, *IDENTITY[1:]]), "frame 1: camera_to_world"),
    "fov of 180": (changed("fov", 180), "frame 1: fov"),
    "time of 2": (changed("render_time", 2), "frame 1: render_time"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    values, message = BAD[name]
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, values)
    assert str(tmp_path / "a.json") in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_what_is_no_json(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json"):
        read_path(tmp_path / "a.json")


# The editor


def camera(x: float) -> ViewCamera:
    return ViewCamera([x, 0, 5], [0, 0, 0], [0, 1, 0], 0.7)


def edited() -> PathEditor:
    editor = PathEditor()
    for number in range(3):
        editor.add(camera(number).pose, 0.1 * number)
    return editor


def test_key_frames_are_added_and_dropped_at_the_end() -> None:
    editor = edited()
    assert [key.second for key in editor.keys] == [0.0, 2.0, 4.0]
    assert editor.keys[1].pose.position.tolist() == [1, 0, 5]
    assert editor.keys[1].time == 0.1
    editor.undo()
    assert [key.second for key in editor.keys] == [0.0, 2.0]


def test_the_preview_shows_the_path_at_that_moment() -> None:
    editor = edited()
    assert editor.preview(100.0) is None
    editor.play(100.0)
    for now in (100.0, 100.7, 103.9):  # however many frames were drawn in between
        shown = editor.preview(now)
        assert shown is not None
        assert_near(shown[0], CameraPath(editor.keys).at(now - 100.0)[0])
    shown = editor.preview(105.0)
    assert shown is not None
    assert_near(shown[0], editor.keys[-1].pose)
    assert editor.preview(105.1) is None


@pytest.mark.kernels
@pytest.mark.triangles
def test_the_window_shows_the_path_at_that_moment(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offscreen = pytest.importorskip("rendercanvas.offscreen")
    pytest.importorskip("imgui_bundle")
    from lapgs_wgpu.viewer import app as app_module
    from lapgs_wgpu.viewer import viewport as viewport_module
    from lapgs_wgpu.viewer.cli import _start
    from lapgs_wgpu.viewer.loaded_scene import load_scene
    from lapgs_wgpu.viewer.options import parse_options

    grid = HashConfig(2, (4, 4, 4), (8, 8, 8), 10)
    config = FieldConfig(static=grid, temporal=grid, width=8)
    scene = Scene4D.from_points(np.eye(3), np.eye(3), np.full(3, 0.2), config, device=device)
    scene.save(tmp_path / "a.ply")
    now = [50.0]
    for module in (app_module, viewport_module):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    canvas = offscreen.RenderCanvas(size=(64, 48), pixel_ratio=1)
    app = app_module.App(canvas, offscreen.loop, load_scene(tmp_path / "a.ply", lambda: device))
    state = app.state
    options = ["a.ply", "--time", "0.2", "--speed", "0.5", "--loop", "bounce", "--mode", "depth", "--fps", "12"]
    _start(parse_options([*options, "--background", "white"])[0], state)
    assert (state.clock.time, state.clock.speed, state.clock.loop, state.clock.fps) == (0.2, 0.5, "bounce", 12.0)
    assert (state.mode, state.background, state.clock.playing) == ("depth", (1.0, 1.0, 1.0), False)
    for turn, time in ((0.0, 0.2), (0.7, 0.8)):
        state.camera.orbit(turn, 0.1)
        state.clock.seek(time)
        state.add_key_frame()
    path = CameraPath(state.path.keys)
    state.path.play(now[0])
    for now[0] in (50.0, 50.4, 51.9, 52.3):  # frames were dropped in between
        canvas.draw()
        pose, time = path.at(now[0] - 50.0)
        assert app.viewport.frame is not None
        request = app.viewport.frame.request
        assert request.time == pytest.approx(time)
        np.testing.assert_allclose(request.camera.position, pose.position, atol=1e-9)
        np.testing.assert_allclose(request.camera.T_cam_world[:3, :3], pose.rotation, atol=1e-9)
    assert state.path.started is None
    state.path.play(now[0])
    app.controls._on_pointer_down({"x": 5, "y": 5, "button": 1, "modifiers": ()})
    assert state.path.started is None
