"""What lapgs-prepare --check says of captures: each measure of one that has the fault and of one that has not."""

import itertools
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.captures import opengl, write_points
from helpers.films import Board, drawn, walk
from PIL import Image

from lapgs_wgpu.command import beside
from lapgs_wgpu.prepare.diagnosis import Measure, _mask, diagnose
from lapgs_wgpu.prepare.report import write_report
from lapgs_wgpu.prepare_cli import prepare_command
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train import plan
from lapgs_wgpu.train.presets import load_config

COUNT, SIZE = 12, (160, 120)
ROOM = np.array([[x, y, z] for x in np.linspace(-1.8, 1.8, 13) for y in (1.0, 2.0) for z in np.linspace(-0.9, 1.8, 9)])


def write_capture(
    folder: Path,
    cameras: list[Camera],
    images: list[np.ndarray],
    times: list[float] | None = None,
    names: list[str] | None = None,
) -> Path:
    """A capture in nerfstudio's form, with points on the room's walls."""
    names = names or [f"{i:03d}.png" for i in range(len(cameras))]
    frames = []
    for i, (camera, image, name) in enumerate(zip(cameras, images, names, strict=True)):
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path)
        time = i / len(cameras) if times is None else times[i]
        frames.append({"file_path": f"images/{name}", "transform_matrix": opengl(camera).tolist(), "time": time})
    K = cameras[0].K
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames, "ply_file_path": "points.ply"}))
    write_points(folder / "points.ply", ROOM, np.full(ROOM.shape, 90), text=True)
    return folder


@pytest.fixture(scope="module")
def pictures() -> tuple[list[Camera], list[np.ndarray], np.ndarray]:
    """Of a walk past a board: cameras, images, and true masks of the board."""
    cameras = walk(COUNT, *SIZE)
    taken = [drawn(camera, i / (COUNT - 1), Board(0.4, 0.3, 1.0)) for i, camera in enumerate(cameras)]
    return cameras, [image for image, _ in taken], np.stack([mask for _, mask in taken])


def write_masks(folder: Path, masks: np.ndarray) -> None:
    (folder / "masks").mkdir()
    for i, mask in enumerate(masks):
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "masks" / f"{i:03d}.png")


def measured(folder: Path, name: str) -> Measure:
    measure = diagnose(folder).measure(name)
    assert measure is not None
    return measure


def test_a_good_walk(pictures, tmp_path: Path) -> None:
    cameras, images, masks = pictures
    write_masks(write_capture(tmp_path, cameras, images), masks)
    found = diagnose(tmp_path)
    assert not found.still
    assert [m.name for m in found.measures if not m.good] == []
    assert found.measure("moving share").number == pytest.approx(masks.mean(), abs=0.005)
    assert 20 < found.measure("parallax").number <= 65
    assert found.measure("exposure").number < 0.1
    assert str(found.measure("parallax")).startswith(" good  parallax: ")


def test_a_camera_that_turns_on_the_spot(pictures, tmp_path: Path) -> None:
    _, images, _ = pictures
    width, height = SIZE
    cameras = [
        Camera.looking_at([0.01 * i, -4.2, 0.7], [x, 0, 0], up=[0, 0, 1], fov_x=0.9, width=width, height=height)
        for i, x in enumerate(np.linspace(-0.5, 0.5, COUNT))
    ]
    write_capture(tmp_path, cameras, images)
    parallax = measured(tmp_path, "parallax")
    assert parallax.good is False
    assert parallax.number == pytest.approx(np.degrees(0.11 / 5.5), rel=0.4)


def test_share_that_moves(pictures, tmp_path: Path) -> None:
    cameras, images, masks = pictures
    folder = write_capture(tmp_path, cameras, images)
    assert measured(folder, "moving share").good is None
    write_masks(folder, np.zeros_like(masks))
    assert measured(folder, "moving share").good is False
    for path in (folder / "masks").iterdir():
        Image.fromarray(np.pad(np.full((60, 120), 255, np.uint8), ((60, 0), (40, 0)))).save(path)
    assert measured(folder, "moving share").good is True
    for path in (folder / "masks").iterdir():
        Image.fromarray(np.full((9, 12), 255, np.uint8)).save(path)
    assert measured(folder, "moving share").good is False


def test_exposure_is_told_from_what_the_camera_sees(pictures, tmp_path: Path) -> None:
    """The same walls, brighter by a stop in the second half."""
    cameras, images, _ = pictures
    brighter = [
        np.clip(image * (2 ** (1 / 2.2) if i >= COUNT // 2 else 1), 0, 255).astype(np.uint8)
        for i, image in enumerate(images)
    ]
    found = measured(write_capture(tmp_path, cameras, brighter), "exposure")
    assert found.number == pytest.approx(1, abs=0.2)
    assert found.good is False


@pytest.mark.parametrize("seeing", [1, 4])
def test_still_cameras(tmp_path: Path, seeing: int) -> None:
    """The board moves where `seeing` of four cameras look."""
    cameras = walk(4, *SIZE)
    used, images, times, names = [], [], [], []
    for number, camera in enumerate(cameras):
        for time in range(5):
            t = time / 4 if number < seeing else 0.0
            used.append(camera)
            images.append(drawn(camera, t, Board(0.4))[0])
            times.append(time / 4)
            names.append(f"cam{number}/{time}.png")
    found = diagnose(write_capture(tmp_path, used, images, times, names))
    assert found.still
    assert found.measure("coverage").number == seeing
    assert found.measure("coverage").good is (seeing >= 3)
    assert found.measure("moving share").number > 0.003 * seeing
    apart = [
        np.arccos(a @ b) for a, b in itertools.pairwise([c.position / np.linalg.norm(c.position) for c in cameras])
    ]
    assert found.measure("spacing").number == pytest.approx(np.degrees(np.median(apart)), rel=0.2)
    assert found.measure("exposure") is None
    assert "4 cameras that stand still" in str(found)


def test_the_report_needs_no_other_file(pictures, tmp_path: Path) -> None:
    cameras, images, masks = pictures
    folder = write_capture(tmp_path / "<walk> & more", cameras, images)
    write_masks(folder, masks)
    write_report(folder, diagnose(folder))
    page = (folder / "report.html").read_text()
    assert "&lt;walk&gt; &amp; more" in page
    assert "<walk>" not in page
    assert page.count("data:image/jpeg;base64,") == COUNT
    assert page.count("<svg") == 1
    assert len(re.findall(r'<circle cx="[\d.]+" cy="[\d.]+" r="3" fill="[^"]+"/>', page)) == COUNT
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert "what moves in red" in page
    for name in ("parallax", "path", "moving share", "exposure"):
        assert f"good  {name}: " in page


def test_check_prints_and_writes(pictures, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    cameras, images, _ = pictures
    folder = write_capture(tmp_path, cameras, images)
    for _ in range(2):  # the page of an earlier run is replaced
        assert prepare_command(["--check", str(folder)]) == 0
        said = capsys.readouterr()
        assert said.out.count("(wanted: ") == 4
        assert "note: " not in said.err
    (folder / "report.html").write_text("<title>mine</title>")
    assert prepare_command(["--check", str(folder)]) == 0
    assert "report.html" in capsys.readouterr().err
    assert (folder / "report.html").read_text() == "<title>mine</title>", "a page of another program stays"
    assert prepare_command(["--check", str(folder / "images")]) == 2


def test_photos_beside_masks_are_no_masks(tmp_path: Path) -> None:
    for name in ("masks", "rgb"):
        (tmp_path / name).mkdir()
    Image.new("L", (8, 8), 200).save(tmp_path / "rgb/0001.png")
    view = SimpleNamespace(source=str(tmp_path / "rgb/0001.png"))
    assert _mask(tmp_path, view) is None


@pytest.mark.nightly
def test_train_goes_on_to_a_scene(
    pictures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """With so little time that a few steps are left; the line that ends it opens the scene."""
    cameras, images, _ = pictures
    dark = [(image * (0.6 if i >= COUNT // 2 else 1)).astype(np.uint8) for i, image in enumerate(images)]
    write_capture(tmp_path / "walk", cameras, dark)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plan, "LEAST_STEPS", 10)
    monkeypatch.setattr(plan, "step_seconds", lambda *_: 0.1)
    assert prepare_command(["--check", "walk", "--train", "--minutes", "0.04"]) == 0
    said = capsys.readouterr().out.splitlines()
    (chosen,) = [line for line in said if line.startswith("training: ")]
    assert "hypernerf-tiny" in chosen
    assert said[-1] == f"{beside('lapgs-view')} {Path('runs', 'walk', 'checkpoint.ply')}"
    assert Path(said[-1].split()[1]).is_file()
    config = load_config("runs/walk/config.toml")
    assert config.schedule.steps == 16
    assert config.exposure.enabled
    assert prepare_command(["--check", "walk", "--train"]) == 2  # before anything is measured
    assert str(Path("runs", "walk")) in capsys.readouterr().err
