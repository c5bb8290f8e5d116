"""The reader of COLMAP's sparse models: its cameras see what the pictures show; one sentence for what is wrong."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.captures import (
    HEIGHT,
    WIDTH,
    Blobs,
    agreement,
    cameras,
    moved,
    quaternion,
    write_colmap,
    write_model,
    write_rig,
)
from PIL import Image
from scipy.spatial import cKDTree

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.cloud import views_of
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import rotation_matrix


@pytest.fixture(scope="module")
def templates(device: Device, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Good captures; tests copy them."""
    folder = tmp_path_factory.mktemp("templates")
    return {
        "bin": write_colmap(folder / "bin", device),
        "txt": write_colmap(folder / "txt", device, binary=False),
        "rig": write_rig(folder / "rig", device),
    }


@pytest.fixture
def toy(templates: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(templates["bin"], tmp_path / "toy"))


@pytest.fixture
def text(templates: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(templates["txt"], tmp_path / "text"))


@pytest.fixture
def rig(templates: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(templates["rig"], tmp_path / "rig"))


LENSES: dict[str, dict[str, float]] = {
    "SIMPLE_PINHOLE": {},
    "PINHOLE": {},
    "SIMPLE_RADIAL": {"k1": 0.25},
    "RADIAL": {"k1": 0.1, "k2": 0.8},
    "OPENCV": {"k1": -0.2, "k2": 0.05, "p1": 0.03, "p2": -0.02},
}


@pytest.mark.parametrize("model", LENSES)
def test_cameras_see_what_the_pictures_show(model: str, device: Device, tmp_path: Path) -> None:
    """Every model, as text and binary, with a principal point that is not in the middle."""
    found = []
    for binary in (True, False):
        folder = tmp_path / str(binary)
        lens = LENSES[model]
        data = load_dataset(
            write_colmap(folder, device, count=5, model=model, lens=lens, binary=binary, principal=(3, -2))
        )
        assert agreement(data, Blobs.random(), device, [0, 4]) > (33 if lens else 50)
        found.append(data)
    for a, b in zip(found[0].train, found[1].train, strict=True):
        np.testing.assert_allclose(a.camera.T_cam_world, b.camera.T_cam_world, atol=1e-12)
        np.testing.assert_allclose(a.camera.K, b.camera.K, atol=1e-9)


def test_pictures_may_be_smaller_than_the_model_says(toy: Path, device: Device) -> None:
    for path in (toy / "images").iterdir():
        Image.open(path).resize((WIDTH // 2, HEIGHT // 2), Image.Resampling.BOX).save(path)
    assert agreement(load_dataset(toy), Blobs.random(), device) > 20
    assert load_dataset(toy, image_size=16).train[0].load().shape == (12, 16, 3)


@pytest.mark.parametrize("name", ["toy", "text"])
def test_the_cloud_brings_its_colors(name: str, request: pytest.FixtureRequest) -> None:
    data = load_dataset(request.getfixturevalue(name))
    blobs = Blobs.random()
    assert data.cloud is not None
    assert data.normalization is not None
    np.testing.assert_allclose(data.cloud.points[:40], data.normalization.points(blobs.means.numpy()), atol=1e-5)
    np.testing.assert_allclose(data.cloud.colors[:40], blobs.colors.numpy(), atol=0.5 / 255 + 1e-6)
    assert np.abs(data.cloud.points[:40]).max() == pytest.approx(1.3, rel=0.1)


def test_a_sparse_cloud_is_filled_up_where_cameras_look(toy: Path) -> None:
    data = load_dataset(toy)
    assert data.cloud is not None
    assert len(data.cloud.points) == 4096
    assert (views_of(data.cloud.points.astype(float), data.cameras) >= len(data.cameras) / 2)[40:].all()
    nearest = cKDTree(data.cloud.points[:40]).query(data.cloud.points[40:])[1]
    np.testing.assert_array_equal(data.cloud.colors[40:], data.cloud.colors[nearest])


def test_rotations_are_quaternions_wxyz() -> None:
    for camera in cameras(3):
        R = camera.T_cam_world[:3, :3]
        np.testing.assert_allclose(rotation_matrix(quaternion(R)), R, atol=1e-12)


def stems(views: Any) -> list[str]:
    return [Path(view.source).stem for view in views]


def test_one_camera_holds_out_every_eighth_moment(device: Device, tmp_path: Path) -> None:
    data = load_dataset(write_colmap(tmp_path / "toy", device, count=14))
    assert stems(data.test) == ["frame_0005", "frame_0013"]
    assert len(data.train) == 12
    assert [view.time for view in data.test] == [4 / 13, 12 / 13]
    assert [view.name for view in data.train[:2]] == ["train_00000", "train_00001"]


def test_frames_go_by_number(device: Device, tmp_path: Path) -> None:
    """frame 10 after frame 9, whatever the file says first; a number that is the same in all names counts nothing."""
    data = load_dataset(write_colmap(tmp_path / "toy", device, count=10, name="clip2_{}.png"))
    assert stems(data.train)[-2:] == ["clip2_9", "clip2_10"]
    assert data.train[-1].time == 1


def test_times_json_goes_before_names(toy: Path) -> None:
    seconds = {f"frame_{i + 1:04d}.png": 3.0 + i * i for i in range(6)}
    (toy / "times.json").write_text(json.dumps(seconds))
    data = load_dataset(toy)
    times = {Path(view.source).name: view.time for view in (*data.train, *data.test)}
    assert times == {name: (value - 3) / 25 for name, value in seconds.items()}
    assert not any("order" in warning for warning in data.warnings)


def test_still_cameras_share_one_pose(rig: Path, device: Device) -> None:
    data = load_dataset(rig)
    assert {Path(view.source).parent.name for view in data.test} == {"cam00"}
    assert (len(data.train), len(data.test), len(data.cameras)) == (9, 3, 3)
    np.testing.assert_allclose(data.times, [0, 0.5, 1])
    everything = [*data.train, *data.test]
    for frame in range(3):
        shown = [i for i, view in enumerate(everything) if view.source.endswith(f"/{frame:04d}.png")]
        assert len(shown) == 4
        assert agreement(data, moved(frame), device, shown) > 50


def test_folders_of_cameras_may_be_links(rig: Path) -> None:
    """Also to places above themselves, which are entered once."""
    expected = [view.source for view in load_dataset(rig).train]
    (rig / "images/cam01").rename(rig / "elsewhere")
    (rig / "images/cam01").symlink_to(rig / "elsewhere")
    (rig / "elsewhere/up").symlink_to(rig / "images")
    assert [view.source for view in load_dataset(rig).train] == expected


def test_pictures_without_a_pose_are_left_out_with_a_warning(toy: Path) -> None:
    shutil.copyfile(toy / "images/frame_0001.png", toy / "images/frame_0099.png")
    data = load_dataset(toy)
    assert len(data.train) + len(data.test) == 6
    assert any("1 of 7 images" in warning and "frame_0099.png" in warning for warning in data.warnings)


def test_a_camera_that_was_not_placed_is_left_out(rig: Path) -> None:
    shutil.copytree(rig / "images/cam01", rig / "images/cam04")
    data = load_dataset(rig)
    assert not any("cam04" in view.source for view in data.train)
    assert any("3 of 15 images" in warning and "cam04" in warning for warning in data.warnings)


def test_the_largest_of_several_models_is_taken(toy: Path) -> None:
    blobs = Blobs.random()
    poses = {"frame_0001.png": cameras(6)[0]}
    colors = np.zeros((40, 3), np.uint8)
    (toy / "sparse/0").rename(toy / "sparse/1")
    write_model(
        toy / "sparse/0", "SIMPLE_PINHOLE", (WIDTH, HEIGHT), [70, 32, 24], poses, blobs.means.double().numpy(), colors,
        binary=False,
    )  # fmt: skip
    data = load_dataset(toy)
    assert len(data.train) == 5
    assert any("2 models (0 with 1, 1 with 6 images): 1 is taken" in warning for warning in data.warnings)


def test_a_model_in_sparse_itself(toy: Path) -> None:
    for path in (toy / "sparse/0").iterdir():
        path.rename(toy / "sparse" / path.name)
    assert len(load_dataset(toy).train) == 5


# What is wrong

Spoil = Callable[[Path], Any]


def line(name: str, old: str, new: str) -> Spoil:
    """Other words in a text model."""

    def change(folder: Path) -> None:
        path = folder / "sparse/0" / name
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return change


def words(name: str, row: int, column: int, new: str) -> Spoil:
    """Another word in a line of a text model, both counted from 0."""

    def change(folder: Path) -> None:
        path = folder / "sparse/0" / name
        lines = path.read_text().split("\n")
        fields = lines[row].split(" ")
        fields[column : column + 1] = [new] if new else []
        lines[row] = " ".join(fields)
        path.write_text("\n".join(lines))

    return change


def gone(name: str) -> Spoil:
    def change(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def renamed(new: Callable[[int], str]) -> Spoil:
    """Other names of the pictures, in folder and model."""

    def change(folder: Path) -> None:
        path = folder / "sparse/0/images.txt"
        content = path.read_text()
        for i in range(1, 7):
            content = content.replace(f"frame_{i:04d}.png", new(i))
            (folder / f"images/frame_{i:04d}.png").rename(folder / "images" / new(i))
        path.write_text(content)

    return change


def times(value: Any) -> Spoil:
    return lambda folder: (folder / "times.json").write_text(json.dumps(value))


def picture(size: tuple[int, int]) -> Spoil:
    return lambda folder: Image.new("RGB", size).save(folder / "images/frame_0002.png")


ALL = {f"frame_{i:04d}.png": i for i in range(1, 7)}
BAD: dict[str, tuple[Spoil, list[str]]] = {
    "no images": (gone("images"), ["images does not exist"]),
    "pictures absent": (lambda f: [gone(f"images/frame_000{i}.png")(f) for i in (2, 3)], ["frame_0002.png", "images"]),
    "no points file": (gone("sparse/0/points3D.txt"), ["points3D.txt"]),
    "fisheye": (line("cameras.txt", "PINHOLE", "OPENCV_FISHEYE"), ["cameras.txt", "OPENCV_FISHEYE", "OPENCV"]),
    "3 parameters": (words("cameras.txt", 1, 7, ""), ["cameras.txt"]),
    "focal tiny": (words("cameras.txt", 1, 4, "1e-9"), ["cameras.txt", "64x48", "0.05"]),
    "focal 0": (words("cameras.txt", 1, 4, "0"), ["cameras.txt", "fx"]),
    "cx NaN": (words("cameras.txt", 1, 6, "nan"), ["cx", "nan"]),
    "width 0": (words("cameras.txt", 1, 2, "0"), ["0x48"]),
    "width of text": (words("cameras.txt", 1, 2, "wide"), ["line 2"]),
    "other proportions": (words("cameras.txt", 1, 3, "64"), ["64x48", "64x64", "cameras.txt"]),
    "short camera": (line("cameras.txt", "7 PINHOLE", "#\n7 PINHOLE\n#"), ["cameras.txt"]),
    "unknown camera": (words("images.txt", 1, 8, "9"), ["images.txt"]),
    "short image": (words("images.txt", 1, 9, ""), ["images.txt", "10"]),
    "long quaternion": (words("images.txt", 1, 1, "3"), ["images.txt"]),
    "translation far": (words("images.txt", 1, 5, "1e12"), ["frame_0001.png", "1e+12", "1e+09"]),
    "translation NaN": (words("images.txt", 1, 5, "nan"), ["nan"]),
    "point of text": (words("points3D.txt", 1, 1, "x"), ["points3D.txt"]),
    "point NaN": (words("points3D.txt", 3, 1, "nan"), ["points3D.txt"]),
    "no images in it": (lambda f: (f / "sparse/0/images.txt").write_text("#\n"), ["sparse/0"]),
    "not text": (lambda f: (f / "sparse/0/images.txt").write_bytes(b"\xff\xfe"), ["images.txt"]),
    "sizes mixed": (picture((32, 24)), ["frame_0002.png", "32x24", "64x48"]),
    "no numbers": (renamed(lambda i: "abcdefg"[i] + ".png"), ["b.png", "times.json"]),
    "two numbers": (renamed(lambda i: f"a{i}_{i * i}.png"), ["a1_1.png", "times.json"]),
    "some numbers": (renamed(lambda i: f"a{i}.png" if i != 3 else "a.png"), ["a.png", "0", "times.json"]),
    "a number twice": (renamed(lambda i: f"{'ab'[i % 2]}{i // 2}.png"), ["frame number 1"]),
    "no time": (times({"frame_0001.png": 1}), ["times.json", "frame_0002.png"]),
    "time of text": (times(ALL | {"frame_0002.png": "1"}), ["times.json", "frame_0002.png", '"1"']),
    "time NaN": (times(ALL | {"frame_0002.png": float("nan")}), ["times.json", "frame_0002.png", "nan"]),
    "times of a list": (times([1]), ["times.json"]),
}  # fmt: skip


def refused(folder: Path, parts: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        load_dataset(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    assert len(message) < 600
    for part in parts:
        assert part in message, message


@pytest.mark.parametrize("name", BAD)
def test_bad_capture_is_refused_in_one_sentence(name: str, text: Path) -> None:
    spoil, parts = BAD[name]
    spoil(text)
    refused(text, parts)


def test_too_few_pictures(device: Device, tmp_path: Path) -> None:
    refused(write_colmap(tmp_path / "toy", device, count=4), ["4 images at 4 times", "at least 5"])


def test_points_behind_the_cameras(text: Path) -> None:
    """Poses that are camera to world, which is the other mistake that is made."""
    path = text / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    for i in range(1, 12, 2):
        fields = lines[i].split(" ")
        fields[7] = "-" + fields[7]
        lines[i] = " ".join(fields)
    path.write_text("\n".join(lines))
    refused(text, ["points3D.txt", "6 of 6 see none of its 40 points", "cameras look away"])


# Binary files are from strangers


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_binary_files(name: str, toy: Path) -> None:
    """Cut anywhere: refused, and never read beyond the end."""
    path = toy / f"sparse/0/{name}.bin"
    whole = path.read_bytes()
    for size in {0, 4, 7, 8, 9, 20, len(whole) // 2, len(whole) - 9, len(whole) - 1}:
        path.write_bytes(whole[:size])
        refused(toy, [f"{name}.bin"])


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [1000, 2**64 - 1])
def test_declared_counts_are_bounded_by_the_file(name: str, count: int, toy: Path) -> None:
    path = toy / f"sparse/0/{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    refused(toy, [f"{name}.bin", f"{count}"])


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_bytes_that_are_left_over(name: str, toy: Path) -> None:
    path = toy / f"sparse/0/{name}.bin"
    whole = path.read_bytes()
    path.write_bytes(whole + b"x")
    refused(toy, [f"{name}.bin declares {len(whole)} bytes", f"has {len(whole) + 1}"])


def test_counts_inside_are_bounded_too(toy: Path) -> None:
    """Points of a picture, and pictures of a point."""
    path = toy / "sparse/0/points3D.bin"
    whole = bytearray(path.read_bytes())
    whole[8 + 8 + 24 + 3 + 8 : 8 + 8 + 24 + 3 + 8 + 8] = struct.pack("<Q", 2**61)
    path.write_bytes(bytes(whole))
    refused(toy, ["points3D.bin declares", "images that see point 0"])
    path = toy / "sparse/0/images.bin"
    whole = bytearray(path.read_bytes())
    at = whole.index(b".png\0") + 5
    whole[at : at + 8] = struct.pack("<Q", 2**61)
    path.write_bytes(bytes(whole))
    refused(toy, ["images.bin declares", "points of frame_0001.png"])


def test_a_name_without_an_end(toy: Path) -> None:
    path = toy / "sparse/0/images.bin"
    path.write_bytes(struct.pack("<QI7dI", 1, 1, 1, *6 * [0.0], 7) + 200 * b"a")
    refused(toy, ["images.bin"])


def test_a_binary_camera_of_another_model(toy: Path) -> None:
    path = toy / "sparse/0/cameras.bin"
    for number, name in ((5, "OPENCV_FISHEYE"), (77, "number 77")):
        path.write_bytes(struct.pack("<QIiQQ8d", 1, 7, number, WIDTH, HEIGHT, *8 * [1.0]))
        refused(toy, ["cameras.bin, camera 0", name])
