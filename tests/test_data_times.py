"""How captures of own footage are understood: layouts, names, times, and what is left out."""

import json
import re
import shutil
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import HEIGHT, WIDTH, cameras, write_model, write_nerfies, write_points, write_polycam
from PIL import Image

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device

MIDDLE = np.array([0.3, -0.2, 0.5])  # what the cameras look at


def write(
    folder: Path, files: Sequence[str], pose: Callable[[int], int] | None = None, named: Sequence[str] = ()
) -> Path:
    """A COLMAP capture of text. pose: which of 12 cameras took each file. named: the model's names, if others."""
    rng = np.random.default_rng(0)
    for file in files:
        (folder / "images" / file).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)).save(folder / "images" / file)
    taken = cameras(12)
    poses = {name: taken[pose(i) if pose else i % 12] for i, name in enumerate(named or files)}
    write_model(folder / "sparse/0", poses, "SIMPLE_PINHOLE", {}, binary=False, points=True, each=False)
    return folder


def times_of(data: Dataset) -> dict[str, float]:
    return {view.source.split("/images/")[-1]: view.time for view in (*data.train, *data.test)}


def test_images_of_a_model_without_blank_lines(tmp_path: Path) -> None:
    folder = write(tmp_path / "toy", [f"{i:04d}.png" for i in range(12)])
    path = folder / "sparse/0/images.txt"
    path.write_text("\n".join(line for line in path.read_text().split("\n") if "#" in line or ".png" in line))
    assert len(times_of(load_dataset(folder))) == 12


NAMES = {
    "backslash": ("cam\\{:04d}.png", "cam/{:04d}.png"),
    "two blanks": ("My  film/frame  {:04d}.png", "My  film/frame  {:04d}.png"),
    "other blanks": ("My film/frame {:04d}.png", "My film/frame  {:04d}.png"),
    "Unicode form": (unicodedata.normalize("NFD", "é/{:04d}.png"), unicodedata.normalize("NFC", "é/{:04d}.png")),
    "letter case": ("CAM/{:04d}.jpg", "cam/{:04d}.JPG"),
    "absolute": ("C:\\walk\\Images\\{:04d}.png", "{:04d}.png"),
    "the folder's own name": ("images/{:04d}.png", "{:04d}.png"),
    "blanks of a URL": ("My%20film/{:04d}.png", "My film/{:04d}.png"),
    "above the folder": ("../walk/a/{:04d}.png", "a/{:04d}.png"),
    "type": ("{:04d}.jpg", "{:04d}.jpeg"),
}


@pytest.mark.parametrize("kind", NAMES)
def test_names_as_other_systems_write_them(kind: str, tmp_path: Path) -> None:
    named, file = ([pattern.format(i) for i in range(12)] for pattern in NAMES[kind])
    data = load_dataset(write(tmp_path / "toy", file, named=named))
    assert set(times_of(data)) == set(file)
    assert not any("left out" in warning for warning in data.warnings)


def transforms(folder: Path, names: Sequence[str]) -> Path:
    """The nerfstudio form of the same."""
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        {"file_path": name, "transform_matrix": (np.linalg.inv(c.T_cam_world) @ flip).tolist(), "time": i / 11}
        for i, (name, c) in enumerate(zip(names, cameras(12), strict=True))
    ]
    values = {"fl_x": 70, "fl_y": 70, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))
    shutil.rmtree(folder / "sparse")
    return folder


@pytest.mark.parametrize("named", ["no suffix", "three rows", "masks", "cloud", "texts", "absolute"])
def test_transforms_as_other_programs_write_them(named: str, tmp_path: Path) -> None:
    """JPEGs without their suffix, poses of three rows, numbers as texts; names that are absolute, or have other case
    and slashes."""
    names = [f"images/{i:04d}.jpg" for i in range(12)]
    folder = transforms(write(tmp_path / "toy", [f"{i:04d}.jpg" for i in range(12)]), names)
    data = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(data["frames"]):
        if named == "no suffix":
            frame["file_path"] = f"images/{i:04d}"
        if named == "three rows":
            frame["transform_matrix"].pop()
        if named == "texts":
            frame["time"] = str(frame["time"])
        if named == "absolute":
            frame["file_path"] = f"C:\\walk\\images\\{i:04d}.jpg"
        if named == "masks":
            frame["mask_path"] = f"Masks\\{i:04d}.PNG"
    if named == "cloud":
        data["ply_file_path"] = "Points.PLY"
        write_points(folder / "points.ply", np.random.default_rng(0).normal(0, 0.1, (200, 3)) + MIDDLE)
    (folder / "transforms.json").write_text(json.dumps(data))
    (folder / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:5] = 0
    for i in range(12):
        Image.fromarray(mask).save(folder / f"masks/{i:04d}.png")
    found = load_dataset(folder)
    assert len(times_of(found)) == 12
    assert (found.cloud is not None) == (named == "cloud")
    if named == "masks":
        np.testing.assert_array_equal(found.train[0].load_ignored(), mask == 0)
    (folder / "Mine").mkdir()
    for file in (folder / "masks").rename(folder / "Mine/Images").iterdir():
        file.rename(file.with_name(f"{file.stem}.PNG"))
    if named == "no suffix":
        view = load_dataset(folder, masks=folder / "Mine").train[0]
        np.testing.assert_array_equal(view.load_ignored(), mask == 255)
        moving = load_dataset(folder, movers="Mine/Images").test[0].moving  # the folder of all images may be missing
        assert moving is not None
        np.testing.assert_array_equal(moving(), mask == 255)


@pytest.mark.parametrize("form", ["COLMAP", "nerfstudio", "smaller", "D-NeRF"])
def test_frames_without_an_image_are_left_out(form: str, tmp_path: Path) -> None:
    names = [f"{i:04d}.png" for i in range(12)]
    folder = write(tmp_path / "toy", names)
    images = folder / "images"
    if form != "COLMAP":
        transforms(folder, [f"images/{name}" for name in names])
    if form == "smaller":
        images = images.rename(folder / "images_4")
    if form == "D-NeRF":
        (folder / "transforms.json").rename(folder / "transforms_train.json")
        shutil.copyfile(folder / "transforms_train.json", folder / "transforms_test.json")
    for name in names[2:4]:
        (images / name).unlink()
    data = load_dataset(folder)
    views = data.train if form == "D-NeRF" else (*data.train, *data.test)
    assert sorted(view.time for view in views) == pytest.approx([i / 11 for i in range(12) if i not in (2, 3)])
    (warning, *_) = [warning for warning in data.warnings if "2 of 12 images" in warning]
    assert "0002.png" in warning
    (images / names[4]).unlink()
    with pytest.raises(InputError, match=r"0002\.png does not exist.* 3 of 12 images"):
        load_dataset(folder)


@pytest.mark.parametrize("named", ["HyperNeRF", "Polycam"])
def test_frames_of_apps_without_an_image_are_left_out(named: str, device: Device, tmp_path: Path) -> None:
    if named == "HyperNeRF":
        folder, file = write_nerfies(tmp_path / "toy", device), "rgb/1x/left_000001.png"
    else:
        folder, file = write_polycam(tmp_path / "toy", device), "keyframes/images/10025000.jpg"
    count = len(times_of(load_dataset(folder)))
    (folder / file).unlink()
    data = load_dataset(folder)
    assert len(times_of(data)) == count - 1
    assert any(f"1 of {count} images" in warning for warning in data.warnings)
    assert data.summary.endswith("; 1 left out")


@pytest.mark.parametrize(
    "pattern",
    [
        "frame{t:06d}/cam{c:02d}.png",
        "cam{c:02d}/frame{t:06d}.png",
        "t{t:04d}/{c}.png",
        "{t:04d}/{c:02d}.png",
        "{c:02d}/{t:04d}.png",
        "{t:04d}/cam_{c}_x.png",
        "{t:03d}/{c}/image.png",
        "cam{c:02d}_{t:04d}.png",
        "frame_{t:04d}_{c}.png",
        "{t:06d}left{c}.png",
    ],
)
@pytest.mark.parametrize("placed", [1, 3, 8])
def test_folders_are_cameras_or_times(pattern: str, placed: int, tmp_path: Path) -> None:
    """Also where the model holds a few images of each still camera only."""
    files = {pattern.format(t=t + 1, c=c): (t, c) for t in range(8) for c in range(4)}
    named = [file for file, (t, _) in files.items() if t < placed]
    data = load_dataset(write(tmp_path / "toy", list(files), lambda i: 3 * (i % 4), named))
    assert times_of(data) == {file: t / 7 for file, (t, _) in files.items()}
    assert {files[view.source.split("/images/")[-1]][1] for view in data.test} == {0}
    assert (len(data.test), len(data.cameras)) == (8, 3)
    assert data.summary.startswith("COLMAP, 4 still cameras, 8 times from")
    assert " is held out; 1 unit of the files becomes " in data.summary


STAMPS = {
    "phone": [f"IMG_20260110_{95848 + i if i < 12 else 95900 + i - 12:06d}.png" for i in range(16)],
    "milliseconds": [f"PXL_20260110_0958{48 + i:02d}123.png" for i in range(12)],
    "decimals": [f"{round(i / 30, 3)}.png" for i in range(24)],
    "twelve hours": [
        f"Shot 2026-01-10 at {(t // 60 - 1) % 12 + 1}.{t % 60:02d}.30 {'AP'[t >= 720]}M.png"
        for t in range(710, 830, 10)
    ],
    "with the unit": [f"{i / 4:g}s.png" for i in range(24)],
    "Unix, with a line": [f"{1700000000 + i // 2}_{50 * (i % 2):02d}0000.png" for i in range(12)],
    "Unix": [f"{1305031102.175304 + 0.5 * i:.6f}.png" for i in range(12)],
}


@pytest.mark.parametrize("kind", STAMPS)
def test_times_in_names(kind: str, tmp_path: Path) -> None:
    files = STAMPS[kind]
    data = load_dataset(write(tmp_path / "toy", files))
    times = times_of(data)
    expected = np.linspace(0, 1, len(files))
    np.testing.assert_allclose([times[file] for file in files], expected, atol=1e-3 if kind == "decimals" else 1e-6)
    assert not any("order" in warning for warning in data.warnings)


@pytest.mark.parametrize("start", ["235855", "095855", "09-58-55", "IMG_09.58.55"])
def test_times_of_day_without_a_date(start: str, tmp_path: Path) -> None:
    """Every ten seconds, past a minute, an hour or midnight."""
    h, m, s = (int(digits) for digits in re.findall(r"\d\d", start))
    seconds = [(3600 * h + 60 * m + s + 10 * i) % 86400 for i in range(12)]
    stamps = [f"{t // 3600:02d}{t // 60 % 60:02d}{t % 60:02d}" for t in seconds]
    separator = next((each for each in "-." if each in start), "")
    before = "IMG_" if start.startswith("I") else ""
    files = [before + separator.join(re.findall("..", stamp)) + ".png" for stamp in stamps]
    data = load_dataset(write(tmp_path / "toy", files))
    times = times_of(data)
    np.testing.assert_allclose([times[file] for file in files], np.linspace(0, 1, 12), atol=1e-9)
    assert "12 times from the clock times" in data.summary


def test_six_digits_of_a_counter_are_no_times_of_day(tmp_path: Path) -> None:
    files = [f"{50 * i:06d}.png" for i in range(12)]  # 000050, 000100, 000150: as times of day, too
    data = load_dataset(write(tmp_path / "toy", files))
    assert "from the frame numbers" in data.summary


@pytest.mark.parametrize("names", [["part1/{:03d}.png", "part2/{:03d}.png"], ["clip/{:03d}.png", "more/{:03d}.png"]])
def test_folders_that_follow_one_another_are_of_one_camera(names: list[str], tmp_path: Path) -> None:
    files = [names[i // 8].format(i) for i in range(16)]
    data = load_dataset(write(tmp_path / "toy", files))
    assert times_of(data) == {file: i / 15 for i, file in enumerate(files)}
    assert "1 moving camera, 16 times" in data.summary
    assert [view.time for view in data.test] == pytest.approx([4 / 15, 12 / 15])
    assert not any("different times" in warning for warning in data.warnings)


@pytest.mark.parametrize("most", [11, 12])
def test_cameras_that_end_apart_are_named(most: int, tmp_path: Path) -> None:
    """As those do that film at twice the rate, too."""
    counts = {"cam0": 6, "cam1": 6, "cam2": most}
    files = [f"{camera}/{t:02d}.png" for camera, count in counts.items() for t in range(count)]
    named = [f"{camera}/00.png" for camera in counts]
    data = load_dataset(write(tmp_path / "toy", files, lambda i: 4 * i, named))
    (warning,) = [warning for warning in data.warnings if "different times" in warning]
    assert f"cam0, cam1 from 0 to 5, cam2 from 0 to {most - 1}" in warning
