"""Masks of what moves: cameras that follow the room though a board fills much of the film, and a user's own masks."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.films import Board, drawn, pose_errors, walk, write_film
from PIL import Image

from lapgs_wgpu.data.images import encode_png
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture import prepare
from lapgs_wgpu.prepare.masks import read_masks
from lapgs_wgpu.prepare.movers import Tracks, agreement, in_mask, rim, standing_share, track_errors

pycolmap = pytest.importorskip("pycolmap")
pytest.importorskip("av")

COUNT, SIZE = 16, (240, 180)


def errors(out: Path) -> np.ndarray:
    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    images = [model.image(i) for i in model.reg_image_ids()]
    assert len(images) >= COUNT - 1
    found = {str(int(image.name[:8]) // 100): np.array(image.projection_center()) for image in images}
    return pose_errors(found, {str(i): camera.position for i, camera in enumerate(walk(COUNT, *SIZE))})


def test_cameras_follow_what_stands_still(tmp_path: Path) -> None:
    """In a film in which a board wanders."""
    taken = [drawn(camera, i / (COUNT - 1), Board(1.1, 0.35, 1.5)) for i, camera in enumerate(walk(COUNT, *SIZE))]
    assert 0.35 < np.mean([mask.mean() for _, mask in taken]) < 0.5
    film = write_film(tmp_path / "film.mp4", [picture for picture, _ in taken], rate=10)
    prepare([film], tmp_path / "out")
    assert errors(tmp_path / "out").max() < 0.02
    overlaps = []
    for i, (_, mask) in enumerate(taken):
        image = Image.open(tmp_path / f"out/masks/{100 * i:08d}.png")
        found = np.asarray(image.resize(SIZE, Image.Resampling.NEAREST)) > 0
        overlaps.append((found & mask).sum() / (found | mask).sum())
    assert np.median(overlaps) > 0.8
    # What was found serves as a user's own masks.
    prepare([film], tmp_path / "again", masks=tmp_path / "out/masks")
    assert errors(tmp_path / "again").max() < 0.02


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(encode_png(np.zeros((60, 60), np.uint8))),
        lambda path: path.write_text("hello"),
        lambda path: shutil.rmtree(path.parent),
    ],
    ids=["one is missing", "another size", "no image", "no folder"],
)
def test_masks_that_do_not_fit(spoil: Callable[[Path], object], tmp_path: Path) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    for name in "abc":
        (folder / f"{name}.png").write_bytes(encode_png(np.eye(60, 80, dtype=np.uint8) * 255))
    names = [f"{name}.jpg" for name in "abc"]
    assert read_masks(folder, names, (160, 120))["b.jpg"].sum() == 60
    spoil(folder / "b.png")
    with pytest.raises(InputError, match="masks"):
        read_masks(folder, names, (160, 120))


def test_a_camera_that_stands_still(tmp_path: Path) -> None:
    """Alone before a board that wanders."""
    camera = walk(3, *SIZE)[1]
    pictures = [drawn(camera, i / 9, Board(0.5, 0.35, 0.7))[0] for i in range(10)]
    film = write_film(tmp_path / "film.mp4", pictures, rate=10)
    with pytest.raises(InputError, match="the camera stands still"):
        prepare([film], tmp_path / "out")
    assert [child.name for child in tmp_path.iterdir()] == ["film.mp4"]


def test_features_that_stay_in_their_place() -> None:
    """Of 4 tracks through 6 images, one stays, one stays too shortly, one drifts, one walks."""
    tracks = Tracks(
        tuple("012345"),
        np.array([*range(6), 0, 1, *range(6), *range(6)]),
        np.array([*[[50.0, 50]] * 6, *[[9.0, 9]] * 2, *([v * i, 9] for v in (0.5, 9.0) for i in range(6))]),
        np.array([0, 6, 8, 14]),
    )  # fmt: skip
    assert standing_share(tracks, (320, 240)) == 0.25
    assert standing_share(tracks, (1920, 1440)) == 0.5  # where 2.5 pixels are little
    nothing = Tracks((), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64))
    assert standing_share(nothing, (320, 240)) == 0.0
    assert standing_share(synthetic(0.0)[0], (320, 240)) < 0.1  # of a camera that walks


def synthetic(noise: float) -> tuple[Tracks, object]:
    """Tracks of 30 still points and 20 that move up, in 6 images; and the true cameras as a reconstruction."""
    rng = np.random.default_rng(0)
    cameras = walk(6, 320, 240)
    points = rng.uniform(-0.8, 0.8, (50, 3))
    model = pycolmap.Reconstruction()
    K = cameras[0].K
    lens = pycolmap.Camera(
        model="PINHOLE", width=320, height=240, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera_id=1
    )
    model.add_camera_with_trivial_rig(lens)
    places = np.zeros((6, 50, 2))
    for i, camera in enumerate(cameras):
        pose = pycolmap.Rigid3d(camera.T_cam_world[:3])
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=i + 1), pose)
        moved = points + np.where(np.arange(50) < 30, 0, 0.06 * i)[:, None] * [0, 0, 1]
        seen = moved @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
        places[i] = seen[:, :2] / seen[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    places += noise * rng.normal(size=places.shape)
    names = tuple(f"{i}.png" for i in range(6))
    return Tracks(names, np.tile(np.arange(6), 50), places.transpose(1, 0, 2).reshape(-1, 2), 6 * np.arange(50)), model


def test_errors_of_tracks() -> None:
    tracks, model = synthetic(0.0)
    found = track_errors(tracks, model)
    assert found[:30].max() < 1e-6
    assert found[30:].min() > 1.0
    noisy = track_errors(synthetic(0.3)[0], model)
    assert noisy[:30].max() < 1.0


def test_places_are_masked_by_the_features_around_them() -> None:
    """Tracks of one image: on the left all still, on the right all moving, but for one in each half."""
    rng = np.random.default_rng(1)
    places = rng.uniform([0, 0], [320, 240], (400, 2))
    right = places[:, 0] > 160
    errors = np.where(right, 5.0, 0.2)
    errors[np.flatnonzero(right)[0]], errors[np.flatnonzero(~right)[0]] = 0.2, 5.0
    tracks = Tracks(("0.png",), np.zeros(400, np.int64), places, np.arange(400))
    still, moving = (masks["0.png"] for masks in agreement(tracks, errors, (320, 240), 1.0))
    assert not (still & moving).any()
    assert still[:, 5:70].mean() > 0.9
    assert moving[:, 90:155].mean() > 0.9
    errors[:] = np.nan
    assert not any(masks["0.png"].any() for masks in agreement(tracks, errors, (320, 240), 1.0))


def test_places_in_masks_of_another_size() -> None:
    mask = rim((320, 240))
    assert mask.shape == (120, 160)
    places = np.array([[160.0, 120.0], [5.0, 5.0], [319.9, 239.9]])
    assert in_mask(mask, places, (320, 240)).tolist() == [True, False, False]
    assert in_mask(None, places, (320, 240)).tolist() == [False] * 3
