"""Every reader: what its cameras see is what the images show, its times, its splits and its cloud are those written."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.captures import (
    HEIGHT,
    WIDTH,
    Blobs,
    agreement,
    bright,
    cameras,
    moved,
    write_arkit,
    write_colmap,
    write_endonerf,
    write_megasam,
    write_model,
    write_nerfies,
    write_nerfstudio,
    write_neu3d,
    write_panoptic,
    write_points,
    write_polycam,
    write_record3d,
    write_rig,
    write_vggt,
)
from helpers.damaged_captures import GONE, put, refused
from PIL import Image
from scipy.ndimage import binary_dilation

from lapgs_wgpu.data import Dataset, View, load_dataset
from lapgs_wgpu.gpu.device import Device

Write = Callable[[Path, Device], Path]
LENS = {"k1": 0.2, "k2": -0.1, "k3": 0.02, "p1": -0.02, "p2": 0.03}
BARREL = {"k1": -0.3, "k2": 0.05}
COLMAP: dict[str, dict[str, float]] = {
    "SIMPLE_PINHOLE": {},
    "PINHOLE": {},
    "SIMPLE_RADIAL": {"k1": 0.25},
    "RADIAL": {"k1": 0.1, "k2": 0.8},
    "OPENCV": {"k1": -0.2, "k2": 0.05, "p1": 0.03, "p2": -0.02},
}
# How a capture is written, and the least PSNR: rounding alone, JPEG, or the interpolation of what undoes a lens.
CAPTURES: dict[str, tuple[Write, float]] = {
    **{f"COLMAP {model}": (partial(write_colmap, model=model, lens=lens, principal=(3, -2)), 33 if lens else 50)
       for model, lens in COLMAP.items()},
    "COLMAP text": (partial(write_colmap, binary=False, principal=(3, -2)), 50),
    "MegaSaM": (write_megasam, 45),
    "VGGT": (write_vggt, 45),
    "nerfstudio": (partial(write_nerfstudio, principal=(3, -2)), 50),
    "nerfstudio lens": (partial(write_nerfstudio, principal=(3, -2), lens=LENS), 33),
    "nerfstudio lens of each": (partial(write_nerfstudio, each=True, lens=LENS), 33),
    "ARKit": (write_arkit, 45),
    "nerfies": (write_nerfies, 50),
    "nerfies lens": (partial(write_nerfies, lens={**LENS, "skew": -2.0}, principal=(3, 2)), 33),
    "nerfies barrel": (partial(write_nerfies, lens=BARREL), 33),
    "nerfies pixels that are not square": (partial(write_nerfies, aspect=1.2), 33),
    "Record3D": (write_record3d, 30),
    "Record3D unpacked": (partial(write_record3d, unpacked=True, each=False), 30),
    "Polycam": (write_polycam, 30),
    "Polycam not corrected": (partial(write_polycam, corrected=False), 30),
}  # fmt: skip


def everything(data: Dataset) -> list[View]:
    return [*data.train, *data.test]


@pytest.mark.parametrize("name", CAPTURES)
def test_cameras_see_what_the_images_show(name: str, device: Device, tmp_path: Path) -> None:
    write, least = CAPTURES[name]
    data = load_dataset(write(tmp_path / "toy", device))
    assert agreement(data, device) > least
    assert all(view.camera.K[0, 1] == 0 for view in data.train)
    if name.startswith("nerfies"):
        assert [Path(view.source).stem for view in everything(data)] == [f"left_{i:06d}" for i in range(5)]
        assert ([view.time for view in data.train], data.test[0].time) == ([0, 0.25, 0.5, 0.75], 1)
    else:
        assert data.own_footage
        assert [len(data.train), len(data.test)] == [5, 1]
        expected = [0, 1 / 6, 1 / 3, 0.5, 2 / 3, 1] if name == "Record3D" else np.linspace(0, 1, 6)
        np.testing.assert_allclose(sorted(view.time for view in everything(data)), expected)
        assert data.test[0].time == pytest.approx(expected[4])


@pytest.mark.parametrize(("write", "last"), [(write_rig, 1.0), (write_neu3d, 2 / 3), (write_panoptic, 1.0)])
def test_still_cameras_share_one_pose(write: Write, last: float, device: Device, tmp_path: Path) -> None:
    """The first camera is held out."""
    data = load_dataset(write(tmp_path / "toy", device))
    assert (len(data.train), len(data.test), len(data.cameras)) == (9, 3, 3)
    np.testing.assert_allclose(data.times, [0, last / 2, last])
    first = "ims/0/" if write is write_panoptic else "cam00"
    assert all(first in view.source for view in data.test)
    assert not any(first in view.source for view in data.train)
    assert agreement(data, device, lambda view: moved(round(2 * view.time / last))) > 50


def test_panoptics_cameras_are_kept(device: Device, tmp_path: Path) -> None:
    """They are calibrated, so no training corrects them; nothing is drawn just before a lens."""
    data = load_dataset(write_panoptic(tmp_path / "toy", device))
    assert not data.own_footage
    assert data.is_rig
    assert data.depths is not None
    assert {view.camera.near for view in everything(data)} == {0.5 * data.depths[0]}
    assert data.test[0].name == "test_cam0_00000"


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (put("train_meta.json", "w2c", 0, 1, 0, 0, 5.0), "w2c"),
        (put("train_meta.json", "k", 2, 0, 0, 0, -5.0), "k"),
        (put("train_meta.json", "k", 2, 0, 2, 2, 5.0), "k"),
        (put("train_meta.json", "fn", 1, 0, "../ims9/000000.png"), "fn"),
        (put("train_meta.json", "fn", 1, 0, 7), "fn"),
        (put("train_meta.json", "cam_id", 1, [1]), "cam_id"),
        (put("test_meta.json", "h", 0), "h"),
    ],
)
def test_damaged_panoptic_captures_are_refused(
    change: Callable[[Path], None], field: str, device: Device, tmp_path: Path
) -> None:
    folder = write_panoptic(tmp_path / "toy", device)
    change(folder)
    refused(folder, field)


CLOUDS: dict[str, tuple[Write, int]] = {
    "COLMAP": (write_colmap, 4096),
    "COLMAP text": (partial(write_colmap, binary=False), 4096),
    "nerfstudio": (write_nerfstudio, 4096),
    "nerfies": (write_nerfies, 40),
    "Neu3D": (write_neu3d, 40),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_the_cloud_is_moved_as_the_cameras_are(name: str, device: Device, tmp_path: Path) -> None:
    """With its colors, which nerfies' lacks; the downsampled cloud of Neu3D before the whole one."""
    write, count = CLOUDS[name]
    folder, blobs = write(tmp_path / "toy", device), Blobs.random()
    if name == "Neu3D":
        write_points(folder / "points3D.ply", np.zeros((7, 3)))
        write_points(folder / "points3D_downsample2.ply", blobs.means.numpy(), blobs.bytes_of_colors)
    data = load_dataset(folder)
    assert data.cloud is not None
    assert data.normalization is not None
    assert len(data.cloud.points) == count
    expected = data.normalization.points(blobs.means.double().numpy())
    np.testing.assert_allclose(data.cloud.points[:40], expected, atol=1e-5)
    np.testing.assert_allclose(
        data.cloud.colors[:40], 0.5 if name == "nerfies" else blobs.colors, atol=0.5 / 255 + 1e-6
    )
    assert np.abs(data.cloud.points[:40]).max() == pytest.approx(1.3, rel=0.1)


@pytest.mark.parametrize("write", [write_megasam, write_nerfies, write_arkit])
def test_without_a_cloud_the_views_fill_the_box(write: Write, device: Device, tmp_path: Path) -> None:
    folder = write(tmp_path / "toy", device)
    (folder / "points.npy").unlink(missing_ok=True)
    data = load_dataset(folder)
    assert data.cloud is None
    assert data.depths is not None
    assert np.linalg.norm(data.focus) < 1.3


# COLMAP


def names(views: Any) -> list[str]:
    return [Path(view.source).name for view in views]


def test_frames_go_by_number(device: Device, tmp_path: Path) -> None:
    """frame 10 after frame 9; a number that is the same in all names counts nothing. Every eighth is held out."""
    data = load_dataset(write_colmap(tmp_path / "toy", device, count=14, name="clip2_{}.png"))
    assert names(data.train)[-2:] == ["clip2_12.png", "clip2_14.png"]
    assert names(data.test) == ["clip2_5.png", "clip2_13.png"]
    assert [view.time for view in data.test] == [4 / 13, 12 / 13]
    assert [view.name for view in data.train[:2]] == ["train_00000", "train_00001"]


@pytest.mark.parametrize("folder", ["", "images/"])
def test_times_json_goes_before_names(folder: str, device: Device, tmp_path: Path) -> None:
    """nerfstudio's may name images below the capture, too."""
    toy = (write_nerfstudio if folder else write_colmap)(tmp_path / "toy", device)
    for i in range(6 if folder else 0):
        put("transforms.json", "frames", i, "time", GONE)(toy)
    seconds = {f"{folder}{path.name}": 3.0 + i * i for i, path in enumerate(sorted((toy / "images").iterdir()))}
    (toy / "times.json").write_text(json.dumps(seconds))
    assert sorted(view.time for view in everything(load_dataset(toy))) == [i * i / 25 for i in range(6)]


def test_folders_of_cameras_may_be_links(device: Device, tmp_path: Path) -> None:
    """Also to places above themselves, which are entered once."""
    rig = write_rig(tmp_path / "rig", device)
    expected = [view.source for view in load_dataset(rig).train]
    (rig / "images/cam01").rename(rig / "elsewhere")
    (rig / "images/cam01").symlink_to(rig / "elsewhere")
    (rig / "elsewhere/up").symlink_to(rig / "images")
    assert [view.source for view in load_dataset(rig).train] == expected


def test_images_and_cameras_without_a_pose_are_left_out_with_a_warning(device: Device, tmp_path: Path) -> None:
    toy, rig = write_colmap(tmp_path / "toy", device), write_rig(tmp_path / "rig", device)
    shutil.copyfile(toy / "images/frame_0001.png", toy / "images/frame_0099.png")
    shutil.copytree(rig / "images/cam01", rig / "images/cam04")
    for folder, left, count in ((toy, "frame_0099.png", 6), (rig, "cam04", 12)):
        data = load_dataset(folder)
        assert len(everything(data)) == count
        assert any(left in warning for warning in data.warnings)


def test_the_largest_of_several_models_is_taken(device: Device, tmp_path: Path) -> None:
    toy = write_colmap(tmp_path / "toy", device, sparse="sparse/1")
    one = {"frame_0001.png": cameras(6)[0]}
    write_model(toy / "sparse/0", one, "PINHOLE", {}, binary=False, points=True, each=False)
    data = load_dataset(toy)
    assert len(data.train) == 5
    assert any("2 models" in warning for warning in data.warnings)


def test_images_may_be_smaller_than_the_model_says(device: Device, tmp_path: Path) -> None:
    toy = write_colmap(tmp_path / "toy", device)
    for path in (toy / "images").iterdir():
        Image.open(path).resize((WIDTH // 2, HEIGHT // 2), Image.Resampling.BOX).save(path)
    assert agreement(load_dataset(toy), device) > 20
    assert load_dataset(toy, image_size=16).train[0].load().shape == (12, 16, 3)


# nerfstudio


def nerfstudio(device: Device, tmp_path: Path, **fields: Any) -> Path:
    folder = write_nerfstudio(tmp_path / "toy", device)
    for name, value in fields.items():
        put("transforms.json", name, value)(folder)
    return folder


def test_applied_transform_was_applied_to_cameras_and_cloud(device: Device, tmp_path: Path) -> None:
    """It tells what was done before, and nothing is left to do."""
    turn = [[0.0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]]
    assert agreement(load_dataset(nerfstudio(device, tmp_path, applied_transform=turn)), device) > 50


def test_the_file_may_list_the_splits(device: Device, tmp_path: Path) -> None:
    """What is in none of them was taken out by somebody. Names may be those of Windows."""
    files = [f"images/frame_{i:05d}.png" for i in range(1, 7)]
    lists = {
        "train_filenames": files[:3],
        "val_filenames": files[3:4],
        "test_filenames": [".\\images\\frame_00005.png"],
    }
    data = load_dataset(nerfstudio(device, tmp_path, **lists))
    assert [len(views) for views in (data.train, data.val, data.test)] == [3, 1, 1]
    assert any("frame_00006.png" in warning for warning in data.warnings)


def test_masks_that_the_file_names_leave_out_what_is_black(device: Device, tmp_path: Path) -> None:
    toy = nerfstudio(device, tmp_path)
    data = json.loads((toy / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
    (toy / "transforms.json").write_text(json.dumps(data))
    refused(toy, "frame 0", "mask_path", "frame_00001.png")
    (toy / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:10, :20] = 0
    for image in (toy / "images").iterdir():
        Image.fromarray(mask).save(toy / "masks" / image.name)
    loaded = load_dataset(toy)
    for view in loaded.train:
        np.testing.assert_array_equal(view.load_ignored(), mask == 0)
    assert all(view.ignored is None for view in loaded.test)


# nerfies, HyperNeRF


def test_lenses_are_ignored_as_published_where_asked(device: Device, tmp_path: Path) -> None:
    folder = write_nerfies(tmp_path / "toy", device, lens={**LENS, "skew": -2.0}, principal=(3, 2))
    for view in load_dataset(folder, undistort=False).train:
        K = view.camera.K
        assert (K[0, 2], K[1, 2], K[0, 1]) == (WIDTH / 2, HEIGHT / 2, 0)
        assert K[0, 0] * np.tan(0.45) == pytest.approx(WIDTH / 2)
        np.testing.assert_array_equal(view.load(), np.asarray(Image.open(view.source)))


@pytest.mark.parametrize("empty", [GONE, []])
def test_splits_of_interpolation(empty: Any, device: Device, tmp_path: Path) -> None:
    """Without val_ids every fourth frame is trained on, and those halfway between are tested."""
    toy = write_nerfies(tmp_path / "toy", device, count=9)
    put("dataset.json", "val_ids", empty)(toy)
    data = load_dataset(toy)
    assert [int(Path(view.source).stem[-3:]) for view in data.train] == [0, 4, 8]
    assert [(int(Path(view.source).stem[-3:]), view.time) for view in data.test] == [(2, 0.25), (6, 0.75)]


def test_times_of_a_rig_are_those_of_time_id(device: Device, tmp_path: Path) -> None:
    toy = write_nerfies(tmp_path / "toy", device)
    for i, time in enumerate([3, 3, 5, 7, 11]):
        put("metadata.json", f"left_{i:06d}", "time_id", time)(toy)
    assert [view.time for view in everything(load_dataset(toy))] == [0, 0, 0.25, 0.5, 1]


@pytest.mark.parametrize(("wanted", "folder", "width"), [(None, "1x", 64), (33, "1x", 33), (32, "2x", 32)])
def test_the_folder_suits_the_wanted_size(
    wanted: int | None, folder: str, width: int, device: Device, tmp_path: Path
) -> None:
    data = load_dataset(write_nerfies(tmp_path / "toy", device), image_size=wanted)
    view = data.train[0]
    assert Path(view.source).parent.name == folder
    assert (view.camera.width, view.load().shape[1]) == (width, width)
    assert agreement(data, device) > 20  # small images are averaged, and drawn with a dilation


@pytest.mark.parametrize("lens", [{**LENS, "skew": 6.0}, BARREL])
def test_masks_are_straightened_as_the_images_are(lens: dict[str, float], device: Device, tmp_path: Path) -> None:
    folder = write_nerfies(tmp_path / "toy", device, count=3, lens=lens)
    for file in (folder / "rgb/1x").glob("*.png"):
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(bright(np.asarray(Image.open(file)))).save(tmp_path / "masks" / file.name)
    view = load_dataset(folder, masks=tmp_path / "masks").train[0]
    mask, seen = view.load_ignored(), bright(view.load())
    assert mask is not None
    assert not (seen & ~mask).any()  # at edges, one of what a pixel mixes is enough
    assert not (mask & ~binary_dilation(seen, iterations=2)).any()


# EndoNeRF, and a phone that stands still


@pytest.mark.parametrize("depth", [True, False])
def test_a_camera_that_stands_still(depth: bool, device: Device, tmp_path: Path) -> None:
    """What to expect is said; depths are those of the maps, or lie between the bounds."""
    data = load_dataset(write_endonerf(tmp_path / "toy", device, depth=depth))
    assert names(data.test) == [f"frame-{i:06d}.color.png" for i in (1, 9)]
    assert len(data.cameras) == 1
    (warning,) = data.warnings
    assert "no parallax" in warning
    if not depth:
        assert data.cloud is None
        return
    assert data.cloud is not None
    assert data.normalization is not None
    points = data.cloud.points / data.normalization.scale + data.normalization.center
    expected = np.asarray(Image.open(tmp_path / "toy/depth/000000.png")).astype(float).mean()
    assert np.abs(points[:, 2] - expected).max() < 0.2 * expected
    # Each point lies on the ray of its pixel: seen from the camera, the cloud is the image.
    camera = data.train[0].camera
    local = data.cloud.points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    places = (local @ camera.K.T)[:, :2] / local[:, 2:]
    image = torch.from_numpy(data.train[0].load()[..., :3].astype(np.float32) / 255)
    column, row = np.clip(places[:4000].astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
    assert np.abs(image[row, column].numpy() - data.cloud.colors[:4000]).mean() < 0.02


def test_a_phone_on_a_tripod(device: Device, tmp_path: Path) -> None:
    """Without a cloud nothing tells its depths, which is said; the scene keeps a sane size."""
    folder = write_record3d(tmp_path / "toy", device)
    poses = json.loads((folder / "metadata.json").read_text())["poses"]
    put("metadata.json", "poses", poses[:1] * len(poses))(folder)
    data = load_dataset(folder)
    assert data.cloud is None
    assert any("is a guess" in warning for warning in data.warnings)
    assert data.depths is not None
    assert 0.1 < data.depths[0] < data.depths[1] < 10
    assert 0.1 < data.scale < 10
