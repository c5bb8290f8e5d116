"""The reader of nerfstudio's transforms.json: its cameras see what pictures show; one sentence for what is wrong."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.captures import HEIGHT, WIDTH, Blobs, agreement, write_nerfstudio, write_points
from PIL import Image

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device

LENS = {"k1": 0.2, "k2": -0.1, "k3": 0.02, "p1": -0.02, "p2": 0.03}


@pytest.fixture(scope="module")
def pictures(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nerfstudio(tmp_path_factory.mktemp("template") / "toy", device)


@pytest.fixture
def make(pictures: Path, tmp_path: Path) -> Callable[[Callable[[dict[str, Any]], Any] | None], Path]:
    """A good capture whose transforms.json is changed."""

    def make(change: Callable[[dict[str, Any]], Any] | None = None) -> Path:
        toy = Path(shutil.copytree(pictures, tmp_path / "toy"))
        data = json.loads((toy / "transforms.json").read_text())
        if change is not None:
            change(data)
        (toy / "transforms.json").write_text(json.dumps(data))
        return toy

    return make


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("lens", [None, LENS])
def test_cameras_see_what_the_pictures_show(each: bool, lens: Any, device: Device, tmp_path: Path) -> None:
    """OpenGL's axes, intrinsics of the file or of each frame, lenses."""
    data = load_dataset(write_nerfstudio(tmp_path / "toy", device, count=5, lens=lens, principal=(3, -2), each=each))
    assert agreement(data, Blobs.random(), device, [0, 4]) > (33 if lens else 50)


def test_times_splits_and_cloud(make: Any) -> None:
    data = load_dataset(make())
    np.testing.assert_allclose([view.time for view in data.train], [0, 0.2, 0.4, 0.6, 1])
    assert [Path(view.source).name for view in data.test] == ["frame_00005.png"]
    blobs = Blobs.random()
    assert data.cloud is not None
    assert data.normalization is not None
    np.testing.assert_allclose(data.cloud.points[:40], data.normalization.points(blobs.means.numpy()), atol=1e-5)
    np.testing.assert_allclose(data.cloud.colors[:40], blobs.colors.numpy(), atol=0.5 / 255 + 1e-6)


def test_applied_transform_was_applied_to_cameras_and_cloud(make: Any, device: Device) -> None:
    """It tells what was done before, and nothing is left to do."""
    turn = [[0.0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]]
    assert agreement(load_dataset(make(lambda data: data.update(applied_transform=turn))), Blobs.random(), device) > 50


def test_the_file_may_say_what_is_held_out(make: Any) -> None:
    names = ["images/frame_00001.png", "./images/frame_00003.png"]
    data = load_dataset(make(lambda data: data.update(test_filenames=names)))
    assert [Path(view.source).name for view in data.test] == ["frame_00001.png", "frame_00003.png"]


def test_lists_of_all_three_splits(make: Any) -> None:
    """What is in none of them was taken out by somebody."""
    names = [f"images/frame_{i:05d}.png" for i in range(1, 7)]
    lists = {"train_filenames": names[:3], "val_filenames": names[3:4], "test_filenames": names[4:5]}
    data = load_dataset(make(lambda data: data.update(lists)))
    assert [len(views) for views in (data.train, data.val, data.test)] == [3, 1, 1]
    assert any("1 of 6 images, such as images/frame_00006.png" in text for text in data.warnings)


def test_without_times_the_names_tell(make: Any) -> None:
    data = load_dataset(make(lambda data: [frame.pop("time") for frame in data["frames"]]))
    np.testing.assert_allclose([view.time for view in data.train], [0, 0.2, 0.4, 0.6, 1])


@pytest.mark.parametrize("folder", ["", "images/"])
def test_listed_times_name_images_below_the_capture_or_below_images(folder: str, make: Any) -> None:
    toy = make(lambda data: [frame.pop("time") for frame in data["frames"]])
    times = {f"{folder}frame_{i:05d}.png": time for i, time in enumerate((0, 1, 2, 3, 5, 10), 1)}
    (toy / "times.json").write_text(json.dumps(times))
    np.testing.assert_allclose([view.time for view in load_dataset(toy).train], [0, 0.1, 0.2, 0.3, 1])


def test_masks_that_the_file_names_leave_out_what_is_black(make: Any) -> None:
    def masked(data: dict[str, Any]) -> None:
        for entry in data["frames"]:
            entry["mask_path"] = entry["file_path"].replace("images", "masks")

    toy = make(masked)
    with pytest.raises(InputError, match=r"frame_00001\.png does not exist, but .*frame 0 names it as its mask_path"):
        load_dataset(toy)
    (toy / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:10, :20] = 0
    for image in (toy / "images").iterdir():
        Image.fromarray(mask).save(toy / "masks" / image.name)
    data = load_dataset(toy)
    for view in data.train:
        ignored = view.load_ignored()
        assert ignored is not None
        np.testing.assert_array_equal(ignored, mask == 0)
    assert all(view.ignored is None for view in data.test)


def test_names_as_windows_writes_them(make: Any) -> None:
    def backslashes(data: dict[str, Any]) -> None:
        for entry in data["frames"]:
            entry["file_path"] = ".\\" + entry["file_path"].replace("/", "\\")
        data["test_filenames"] = ["images\\frame_00002.png"]

    data = load_dataset(make(backslashes))
    assert [Path(view.source).name for view in data.test] == ["frame_00002.png"]


def test_a_picture_of_another_type(make: Any) -> None:
    toy = make(frame(file_path="images/a.webp"))
    Image.new("RGB", (WIDTH, HEIGHT)).save(toy / "images/a.webp")
    with pytest.raises(InputError, match=r"a\.webp is neither PNG nor JPEG, but .*frame 1 names it as file_path"):
        load_dataset(toy)


def test_a_binary_cloud(make: Any) -> None:
    toy = make()
    expected = load_dataset(toy).cloud
    blobs = Blobs.random()
    write_points(toy / "sparse_pc.ply", blobs.means.numpy(), (blobs.colors * 255).round().numpy())
    cloud = load_dataset(toy).cloud
    assert cloud is not None
    assert expected is not None
    np.testing.assert_allclose(cloud.points, expected.points, atol=1e-5)
    np.testing.assert_allclose(cloud.colors, expected.colors, atol=1e-6)


def test_without_a_cloud_the_views_fill_the_box(make: Any, device: Device) -> None:
    data = load_dataset(make(lambda data: data.pop("ply_file_path")))
    assert data.cloud is None
    assert data.depths is not None
    assert np.linalg.norm(data.focus) < 1.3
    assert agreement(data, Blobs.random(), device) > 50


def frame(**fields: Any) -> Callable[[dict[str, Any]], Any]:
    """Other fields of frame 1; None removes one."""

    def change(data: dict[str, Any]) -> None:
        merged = data["frames"][1] | fields
        data["frames"][1] = {name: value for name, value in merged.items() if value is not None}

    return change


def top(**fields: Any) -> Callable[[dict[str, Any]], Any]:
    def change(data: dict[str, Any]) -> None:
        merged = data | fields
        data.clear()
        data.update({name: value for name, value in merged.items() if value is not None})

    return change


def opencv(data: dict[str, Any]) -> None:
    for each in data["frames"]:
        each["transform_matrix"] = (np.array(each["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])).tolist()


def opencv_without_cloud(data: dict[str, Any]) -> None:
    opencv(data)
    del data["ply_file_path"]


SCALED = (2 * np.eye(4)).tolist()
BAD: dict[str, tuple[Callable[[dict[str, Any]], Any], list[str]]] = {
    "picture elsewhere": (frame(file_path="../other/a.png"), ["frame", "file_path"]),
    "cloud elsewhere": (top(ply_file_path="/a.ply"), ["ply_file_path"]),
    "no frames": (top(frames=None), ["frames"]),
    "frames empty": (top(frames=[]), ["frames"]),
    "a frame of text": (lambda data: data["frames"].__setitem__(1, "x"), ["frame 1"]),
    "no file_path": (frame(file_path=None), ["file_path"]),
    "file_paths absent": (lambda data: [each.update(file_path="images/x.png") for each in data["frames"]], ["x.png"]),
    "file_path twice": (frame(file_path="images/frame_00001.png"), ["frame_00001.png"]),
    "no matrix": (frame(transform_matrix=None), ["transform_matrix"]),
    "matrix scaled": (frame(transform_matrix=SCALED), ["transform_matrix"]),
    "no fl_x": (top(fl_x=None), ["fl_x"]),
    "fl_x tiny": (top(fl_x=1e-9), ["transforms.json", "0.05"]),
    "fl_x 0": (top(fl_x=0), ["fl_x"]),
    "fl_x of text": (top(fl_x="wide"), ["fl_x", '"wide"']),
    "cx NaN": (frame(cx=math.nan), ["cx", "nan"]),
    "w 0": (top(w=0), ["w must be"]),
    "w half": (top(w=32), ["64x48", "32x48"]),
    "fisheye": (top(camera_model="OPENCV_FISHEYE"), ["camera_model", "OPENCV_FISHEYE", "PINHOLE"]),
    "fisheye of instant-ngp": (top(is_fisheye=True), ["is_fisheye", "undistort"]),
    "k4": (top(k4=0.1), ["k4 must be", "0.1"]),
    "wild lens": (top(k1=-90), ["frame 0"]),
    "time absent": (frame(time=None), ["time"]),
    "time of text": (frame(time="1"), ["time", '"1"']),
    "ply absent": (top(ply_file_path="x.ply"), ["x.ply", "ply_file_path"]),
    "ply of a number": (top(ply_file_path=3), ["ply_file_path"]),
    "test unknown": (top(test_filenames=["x.png"]), ["test_filenames"]),
    "test all": (top(test_filenames=[f"images/frame_{i:05d}.png" for i in range(1, 7)]), ["all 6 images"]),
    "test of numbers": (top(test_filenames=[3]), ["test_filenames"]),
    "OpenCV's axes": (opencv, ["OpenGL"]),
    "the same without a cloud": (opencv_without_cloud, ["OpenGL"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_capture_is_refused_in_one_sentence(name: str, make: Any, tmp_path: Path) -> None:
    change, words = BAD[name]
    refused(make(change), [str(tmp_path / "toy"), *words])


def refused(folder: Path, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        load_dataset(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    assert len(message) < 600
    for word in words:
        assert word in message, message


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("element vertex 40", "element vertex 41", ["declares 41", "40 lines"]),
        ("element vertex 40", f"element vertex {10**15}", [f"{10**15} rows", "truncated"]),
        ("element vertex 40", "element vertex -1", ["count"]),
        ("element vertex", "element face", ["no element vertex"]),
        ("property float x", "property float a", ["properties x, y, z"]),
        ("end_header\n", "end_header\nx ", ["row 0", "6 numbers"]),
        ("end_header\n", "end_header\n7\n", ["row 0", "'7'", "6 numbers"]),
        ("end_header\n", "end_header\nnan nan nan 0 0 0\n", ["NaN", "1 of 40 points", "point 0"]),
        ("end_header", "end", ["end_header"]),
    ],
)
def test_a_bad_cloud_of_text(old: str, new: str, words: list[str], make: Any) -> None:
    toy = make()
    path = toy / "sparse_pc.ply"
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    refused(toy, ["sparse_pc.ply", *words])


def test_a_time_of_null_is_no_time(make: Any) -> None:
    refused(make(lambda data: data["frames"][1].update(time=None)), ["frame 1: time must be made of numbers", "null"])


def test_sizes_mixed(make: Any) -> None:
    toy = make()
    Image.new("RGB", (WIDTH // 2, HEIGHT // 2)).save(toy / "images/frame_00002.png")
    refused(toy, ["frame_00002.png", "32x24", "64x48"])
