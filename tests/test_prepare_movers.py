"""Masks of what moves: cameras that follow the room though a board fills much of the film, and a user's own masks."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.films import Board, drawn, pose_errors, walk, write_film
from PIL import Image
from scipy.spatial.transform import Rotation

from lapgs_wgpu.data.images import encode_png
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture import prepare
from lapgs_wgpu.prepare.depth_errors import depth_errors
from lapgs_wgpu.prepare.movers import RIM, Judged, Motion, read_masks
from lapgs_wgpu.prepare.poses import in_mask, without

pycolmap = pytest.importorskip("pycolmap")
pytest.importorskip("av")
pytest.importorskip("cv2")

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
    (tmp_path / "own").mkdir()
    for i, (_, mask) in enumerate(taken):
        Image.fromarray(np.uint8(255) * mask.astype(np.uint8)).save(tmp_path / f"own/{100 * i:08d}.png")
    prepare([film], tmp_path / "again", masks=tmp_path / "own")
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


def test_a_camera_that_stands_still(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """Alone before a board that wanders: a pan that does not turn."""
    camera = walk(3, *SIZE)[1]
    pictures = [drawn(camera, i / 9, Board(0.5, 0.35, 0.7))[0] for i in range(10)]
    film = write_film(tmp_path / "film.mp4", pictures, rate=10)
    prepare([film], tmp_path / "out")
    assert re.search("(?s)the camera stands still.*10 of 10 cameras placed", capfd.readouterr().out)
    with Image.open(tmp_path / "out/masks/00000500.png") as mask:
        assert (np.asarray(mask) > 127)[drawn(camera, 5 / 9, Board(0.5, 0.35, 0.7))[1]].mean() > 0.8


# Errors of ways


def seen_by(cameras: list, points: np.ndarray) -> np.ndarray:
    """(k, n, 2) directions of points (n, 3), or of (k, n, 3) that move."""
    found = []
    for i, camera in enumerate(cameras):
        at = (points if points.ndim == 2 else points[i]) @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
        found.append(at[:, :2] / at[:, 2:])
    return np.stack(found)


def relative(cameras: list) -> np.ndarray:
    """(k, 4, 4) poses of all but the first camera, seen from that."""
    return np.stack([camera.T_cam_world for camera in cameras[1:]]) @ np.linalg.inv(cameras[0].T_cam_world)


def test_still_points_are_explained_and_others_are_not() -> None:
    rng = np.random.default_rng(0)
    cameras = walk(12, 320, 240)[:5]
    points = rng.uniform(-0.8, 0.8, (50, 3))
    lift = np.where(np.arange(50) < 30, 0, 0.05) * np.arange(5)[:, None]  # the last 20 go up
    moved = points + lift[..., None] * [0, 0, 1]
    seen = seen_by(cameras, moved) + rng.normal(size=(5, 50, 2)) * 1e-4
    seen[2, 0] = np.nan  # lost in one image, and in all but one
    seen[1:4, 1] = np.nan
    total, each = depth_errors(seen[0], seen[1:], relative(cameras), np.full(4, 2e-4), 1.0)
    assert np.isnan(total[1])
    assert np.isnan(each[1, 0])
    assert np.nanmax(total[:30]) < 2
    assert total[30:].min() > 10


def test_what_is_nearer_than_the_scene_or_behind_infinity_is_not_explained() -> None:
    """What goes along with a camera that walks sideways lies on each epipolar line, but at no depth there is."""
    cameras = walk(12, 320, 240)[:5]
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (20, 3))
    seen = seen_by(cameras, points)
    poses, sigma = relative(cameras), np.full(4, 2e-4)
    assert depth_errors(seen[0], seen[1:], poses, sigma, 1.0)[0].max() < 0.1
    assert depth_errors(seen[0], seen[1:], poses, sigma, 0.05)[0].min() > 5, "all is nearer than allowed"
    poses[:, :3, 3] *= -1
    assert depth_errors(seen[0], seen[1:], poses, sigma, 1.0)[0].min() > 5, "all is behind infinity"


def test_a_camera_that_turns_needs_no_depth() -> None:
    rng = np.random.default_rng(2)
    ray = rng.uniform(-0.3, 0.3, (30, 2))
    poses, seen = np.tile(np.eye(4), (3, 1, 1)), []
    for pose, turn in zip(poses, (0.02, 0.05, 0.09), strict=True):
        pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        at = np.column_stack([ray, np.ones(30)]) @ pose[:3, :3].T
        seen.append(at[:, :2] / at[:, 2:] + np.where(np.arange(30) < 20, 0, turn / 4)[:, None])
    total, _ = depth_errors(ray, np.stack(seen), poses, np.full(3, 5e-4), 1.0)
    assert total[:20].max() < 1e-3
    assert total[20:].min() > 5


def test_errors_that_change_evenly_over_an_image_are_left_out() -> None:
    """Of cameras that are 0.5 degrees off, the farther the more, and a quarter of the places moves by itself."""
    cameras, points = walk(12, 320, 240)[:5], np.random.default_rng(3).uniform(-0.8, 0.8, (800, 3))
    moves = points[:, 0] > 0.4
    lift = 0.05 * np.where(moves, 1, 0) * np.arange(5)[:, None]
    seen, sigma = seen_by(cameras, points + lift[..., None] * [0, 0, 1]), np.full(4, 2e-4)
    poses = relative(cameras)
    for i, pose in enumerate(poses, start=1):
        pose[:3] = Rotation.from_rotvec(np.radians([0.1, 0.0, 0.5]) * i / 4).as_matrix() @ pose[:3]
    rough = depth_errors(seen[0], seen[1:], poses, sigma, 1.0)[0]
    even = depth_errors(seen[0], seen[1:], poses, sigma, 1.0, even=True)[0]
    assert np.median(rough[~moves]) > 3
    assert np.median(even[~moves]) < 1
    assert even[moves].min() > 5


def test_places_are_followed_and_lost() -> None:
    """A texture that wanders by 3 pixels an image, and out of it on the left."""
    rng = np.random.default_rng(3)
    wide = np.asarray(Image.fromarray(rng.integers(0, 255, (40, 60, 3), dtype=np.uint8)).resize((180, 120)))
    images = [np.ascontiguousarray(wide[:, 3 * i : 3 * i + 160]) for i in range(5)]
    motion = Motion([(image, True) for image in images], list("abcde"))
    way = motion.tracks[0][4] - motion.grid
    inside = (slice(3, 8), slice(4, 12))
    assert np.abs(way[inside] - [-12, 0]).max() < 0.7
    assert np.isnan(way[:, :2]).all()
    assert np.isfinite(way[:, 4:]).mean() > 0.9
    assert sorted(motion.tracks[3]) == [-3, -2, -1, 1]
    two_steps = [(image, i % 2 == 0) for i, image in enumerate(images)]  # from one to the next
    half = Motion(two_steps, list("ace"))
    assert np.abs((half.tracks[0][2] - half.grid)[inside] - [-12, 0]).max() < 0.7


def test_matches_without_masked_features() -> None:
    mask = RIM
    size = (320, 240)
    places = np.array([[160.0, 120.0], [5.0, 5.0], [319.9, 239.9]])
    assert in_mask(mask, places, size).tolist() == [True, False, False]
    matches = {("a", "b"): np.array([[0, 1], [1, 1], [2, 0]])}
    found = without(matches, {"a": places, "b": places}, {"a": mask, "b": np.zeros((1, 1), bool)}, size)
    assert found["a", "b"].tolist() == [[1, 1], [2, 0]]


def test_cameras_that_follow_what_moves_in_a_part_of_the_film() -> None:
    """In the first image they fit its left quarter alone, in the second all but that: both see it move."""
    moves = np.tile(np.arange(12) < 3, (9, 1))
    errors = np.stack([np.where(moves, 1.0, 8.0), np.where(moves, 20.0, 1.0)]).astype(np.float32)
    wrong = Judged(["a", "b"], errors, np.log(errors), float(np.log(5)), 0.3)
    right = wrong._replace(errors=errors[[1, 1]])
    assert (wrong.contradicted(), right.contradicted()) == (["a"], [])
    assert right.explained(wrong) == pytest.approx(1.5)
    wider = [mask.mean() for mask in wrong.rough(turned_over=True).values()]
    assert wider == [pytest.approx(1 / 3)] * 2
