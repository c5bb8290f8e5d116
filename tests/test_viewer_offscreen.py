"""lapgs-view without a screen: pictures equal the evaluator's, videos and stills read back, mistakes are told."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.ply_files import FIELDS, read_ply
from helpers.scene_files import moving_scene
from PIL import Image
from synthetic import write_synthetic

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu import device as device_module
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D, load
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.evaluate import to_8_bit
from lapgs_wgpu.viewer import offscreen as offscreen_module
from lapgs_wgpu.viewer.cli import view_command
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.offscreen import framed

pytestmark = pytest.mark.triangles
kernels = pytest.mark.kernels


@pytest.fixture(scope="module")
def run(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder: a checkpoint, and the config.toml that names its capture."""
    folder = tmp_path_factory.mktemp("run")
    data = write_synthetic(folder / "toys", size=24, train_views=3, test_views=2)
    (folder / "config.toml").write_text(f'[data]\npath = "{data}"\nsize = 0\n')
    scene = moving_scene(device, sh_degree=3)
    scene.save(folder / "checkpoint.ply", {"background": "white"})
    still = Scene4D.from_points(np.eye(3), np.eye(3), np.full(3, 0.2), FieldConfig(kind="static"), device=device)
    still.save(folder / "still.ply")
    return folder


@pytest.fixture(scope="module")
def scene(run: Path, device: Device) -> Scene4D:
    return load(run / "checkpoint.ply", device)


@pytest.fixture(autouse=True)
def one_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "open_device", lambda name=None: device)


def view(*words: object) -> None:
    assert view_command([str(word) for word in words]) == 0


def picture(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file)).astype(int)


# Pictures


def expected_picture(scene: Scene4D, camera: Camera, time: float, color: float = 1.0) -> np.ndarray:
    return to_8_bit(scene.render(camera, time, torch.full((3,), color)).image).astype(int)


@kernels
@pytest.mark.parametrize("number", [0, 4])
def test_a_screenshot_of_a_view_is_the_evaluators_picture(
    number: int, run: Path, scene: Scene4D, tmp_path: Path
) -> None:
    dataset = load_dataset(run / "toys")
    wanted = (*dataset.test, *dataset.train)[number]
    for name in (number, wanted.name):
        view(run / "checkpoint.ply", "--screenshot", tmp_path / "a.png", "--view", name)
        got = picture(tmp_path / "a.png")
        assert got.shape == (24, 24, 3)
        assert np.abs(got - expected_picture(scene, wanted.camera, wanted.time)).max() <= 1


@kernels
def test_time_background_and_size_of_a_view(run: Path, scene: Scene4D, tmp_path: Path) -> None:
    wanted = load_dataset(run / "toys").test[0]
    words = ("--view", 0, "--time", "0.9", "--background", "black", "--size", "60x48")
    view(run / "checkpoint.ply", "--screenshot", tmp_path / "a.png", *words)
    camera = framed(wanted.camera, 60, 48)
    assert (camera.K[0, 0], camera.K[0, 2]) == pytest.approx((2 * wanted.camera.K[0, 0], 30))
    assert np.abs(picture(tmp_path / "a.png") - expected_picture(scene, camera, 0.9, 0.0)).max() <= 1
    assert np.abs(expected_picture(scene, camera, 0.9) - expected_picture(scene, camera, 0.1)).max() > 20


@kernels
@pytest.mark.parametrize("mode", ["depth", "alpha", "motion"])
def test_every_mode_gives_a_picture(mode: str, run: Path, tmp_path: Path) -> None:
    view(run / "checkpoint.ply", "--screenshot", tmp_path / "a.png", "--mode", mode, "--size", "40x30")
    got = picture(tmp_path / "a.png")
    assert got.shape == (30, 40, 3)
    assert got.std() > 5
    assert (got[..., 0] == got[..., 1]).all() == (mode == "alpha")


# Videos


def frames_of(file: Path) -> np.ndarray:
    with pytest.importorskip("av").open(str(file)) as video:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]).astype(int)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Mean difference of two pictures (H, W, 3), 2 x 2 pixels at a time: yuv420p keeps no finer colors."""
    height, width = a.shape[:2]
    blocks = (a - b).reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
    return float(np.abs(blocks).mean())


@kernels
def test_a_video_of_the_clip(run: Path, scene: Scene4D, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.mp4"
    view(run / "checkpoint.ply", "--video", file, "--view", 0, "--size", "65x49", "--fps", "12", "--seconds", "0.75")
    assert "65x49 becomes 64x48" in capsys.readouterr().err
    got = frames_of(file)
    assert got.shape == (9, 48, 64, 3)
    with pytest.importorskip("av").open(str(file)) as video:
        context = video.streams.video[0].codec_context
        assert (context.framerate, context.name, context.pix_fmt) == (12, "h264", "yuv420p")
    camera = framed(load_dataset(run / "toys").test[0].camera, 64, 48)
    for frame, time in zip(got, np.linspace(0, 1, 9), strict=True):
        assert distance(frame, expected_picture(scene, camera, time)) < 4.5
    assert distance(got[0], expected_picture(scene, camera, 1.0)) > 10
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mp4"]


@kernels
def test_a_turn_goes_around_while_time_stands(run: Path, tmp_path: Path) -> None:
    words = ("--size", "32x24", "--path", "view", "--time", "0.5", "--seconds", "0.4", "--fps", "10")
    view(run / "checkpoint.ply", "--video", tmp_path / "a.mp4", *words)
    view(run / "checkpoint.ply", "--screenshot", tmp_path / "a.png", "--size", "32x24", "--time", "0.5")
    got = frames_of(tmp_path / "a.mp4")
    assert len(got) == 4
    assert distance(got[0], picture(tmp_path / "a.png")) < 4.5
    assert distance(got[2], got[0]) > 8  # from behind


def test_where_cameras_stand_on_one_side_a_turn_swings_between_them() -> None:
    from lapgs_wgpu.io.initial_view import InitialView, captured_arc
    from lapgs_wgpu.viewer.camera import ViewCamera, orbit_views

    def standing(degrees: float) -> Camera:
        place = [3 * np.cos(np.radians(degrees)), 3 * np.sin(np.radians(degrees)), 1]
        return Camera.looking_at(place, [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=8, height=6)

    focus, up = np.zeros(3), np.array([0.0, 0.0, 1.0])
    cameras = [standing(each) for each in (-20, 0, 15, 40)]
    arc = captured_arc(cameras[1], cameras, focus, up)
    assert arc == pytest.approx((20, 40))
    look = InitialView(cameras[1], focus, up, 4, arc)
    assert InitialView.from_json(look.to_json()).arc == pytest.approx(arc)
    assert look.arc_from(cameras[2]) == pytest.approx((35, 25))
    assert captured_arc(cameras[1], [standing(each) for each in range(0, 360, 60)], focus, up) is None

    start = ViewCamera(cameras[1], focus, up)
    places = np.stack([camera.position for camera, _ in orbit_views(start, (8, 6), 4, None, arc)])
    for place, degrees in zip(places, (0, -20, 0, 40), strict=True):
        np.testing.assert_allclose(place, standing(degrees).position, atol=1e-6)


def test_ctrl_c_leaves_no_file(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = offscreen_module.OffscreenRenderer.__call__
    calls: list[int] = []

    def interrupted(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return drawn(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(offscreen_module.OffscreenRenderer, "__call__", interrupted)
    words = [str(run / "checkpoint.ply"), "--video", str(tmp_path / "a.mp4"), "--size", "32x24"]
    assert view_command(words) == 130
    assert list(tmp_path.iterdir()) == []
    assert "interrupted" in capsys.readouterr().err


def test_without_pyav_one_sentence_says_what_to_install(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    assert view_command([str(run / "checkpoint.ply"), "--video", str(tmp_path / "a.mp4")]) == 2
    assert capsys.readouterr().err == 'lapgs-view: writing mp4 needs PyAV: pip install "lapgs-wgpu[video]"\n'
    assert list(tmp_path.iterdir()) == []


# Stills


def assert_still(file: Path, scene: Scene4D, time: float) -> None:
    found, exact = read_ply(file), scene.snapshot(time)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=1e-3, atol=2e-3, err_msg=name)


@kernels
def test_an_exported_still(run: Path, scene: Scene4D, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "still.ply"
    view(run / "checkpoint.ply", "--export", file, "--time", "0.7")
    assert_still(file, scene, 0.7)
    assert view_command([str(run / "checkpoint.ply"), "--export", str(file)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert_still(file, scene, 0.7)
    view(run / "checkpoint.ply", "--export", file, "--overwrite")
    assert_still(file, scene, 0.0)


def test_the_opened_file_is_never_replaced(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "checkpoint.ply").read_bytes()
    assert view_command([str(run / "checkpoint.ply"), "--export", str(run / "checkpoint.ply"), "--overwrite"]) == 2
    assert "is the opened file" in capsys.readouterr().err
    assert (run / "checkpoint.ply").read_bytes() == before


# Mistakes

MISTAKES = {
    "frames alone": (["CHECKPOINT", "--frames", "3"], "--frames"),
    "time of a clip": (["CHECKPOINT", "--video", "a.mp4", "--time", "0.5"], "--path time"),
    "motion of a still scene": (["STILL", "--screenshot", "a.png", "--mode", "motion"], "motion"),
    "no file": (["--screenshot", "a.png"], "name a file"),
    "no size": (["CHECKPOINT", "--screenshot", "a.png", "--size", "8"], "WIDTHxHEIGHT"),
    "a jpeg": (["CHECKPOINT", "--screenshot", "a.jpg"], "ends with .png"),
    "a folder without frames": (["CHECKPOINT", "--export", "a"], "--frames"),
    "an unknown view": (["CHECKPOINT", "--screenshot", "a.png", "--view", "99"], "--view 99"),
    "a missing folder": (["CHECKPOINT", "--screenshot", "no/a.png", "--size", "8x8"], "no/a.png"),
    "frames in a file": (["CHECKPOINT", "--export", "used", "--frames", "2"], "used"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_end_in_one_sentence(
    name: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "used").write_text("")
    words, message = MISTAKES[name]
    places = {"CHECKPOINT": str(run / "checkpoint.ply"), "STILL": str(run / "still.ply")}
    assert view_command([places.get(word, word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("lapgs-view: ")
    assert message in err
    assert [file.name for file in tmp_path.iterdir()] == ["used"]


@pytest.mark.parametrize(("line", "expected"), [("undistort = false", False), ("", True)])
def test_the_capture_opens_as_the_training_opened_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, expected: bool
) -> None:
    opened: list[dict[str, object]] = []
    monkeypatch.setattr(
        "lapgs_wgpu.data.load_dataset",
        lambda path, **given: opened.append(given) or SimpleNamespace(test=("a",), train=("b",)),
    )
    (tmp_path / "config.toml").write_text(f'[data]\npath = "{tmp_path}"\nsize = 200\nmovers = "masks"\n{line}\n')
    scene = SimpleNamespace(path=tmp_path / "checkpoint.ply", playback=SimpleNamespace(metadata={}))
    assert LoadedScene.views.func(scene) == ("a", "b")
    assert opened == [{"image_size": 200, "undistort": expected, "movers": "masks"}]
