"""Cameras of films: pans by their rotations, the path of a hand, and the part of a film that fits together."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.films import Board, drawn, walk, write_film
from scipy.spatial.transform import Rotation

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.prepare.capture import prepare
from lapgs_wgpu.prepare.film import images_per_second
from lapgs_wgpu.prepare.pan import rays, solve_pan
from lapgs_wgpu.prepare.poses import nearest
from lapgs_wgpu.prepare.search import longest_part, path_faults
from lapgs_wgpu.splat.camera import Camera

pytest.importorskip("av")
pytest.importorskip("pycolmap")
pytest.importorskip("cv2")

SIZE = (640, 360)


def pan_matches(count: int, walks: float, moving: float) -> tuple[list[str], dict, dict, np.ndarray]:
    """Places and matches of points around a camera of focal length 700 that turns by 2 degrees an image and goes
    sideways by `walks`, a share of which moves; and its true rotations."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points *= rng.uniform(2, 6, (3000, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    turns = Rotation.from_euler("yx", [[2 * i, 0.3 * np.sin(i)] for i in range(count)], degrees=True).as_matrix()
    names, places, seen = [f"{i:02d}.jpg" for i in range(count)], {}, []
    for i, name in enumerate(names):
        at = points + np.where(np.arange(3000) < 3000 * moving, 0.05 * i, 0.0)[:, None] * [0, 1, 0]
        at = (at - [walks * i, 0, 0]) @ turns[i].T
        pixels = 700 * at[:, :2] / at[:, 2:] + np.array(SIZE) / 2 + rng.normal(size=(3000, 2)) * 0.2
        seen.append((at[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < SIZE).all(axis=1))
        places[name] = pixels
    matches = {}
    for i in range(count):
        for j in range(i + 1, min(count, i + 9)):
            both = np.flatnonzero(seen[i] & seen[j])
            matches[names[i], names[j]] = np.stack([both, both], axis=1)
    return names, places, matches, turns


def test_a_pan() -> None:
    """With something that moves in front, from a wrong focal length."""
    names, places, matches, turns = pan_matches(14, 0.0, 0.2)
    pan = solve_pan(names, places, matches, SIZE, 1000.0)
    assert pan is not None
    off = pan.rotations @ pan.rotations[0].T @ turns[0] @ turns.transpose(0, 2, 1)
    assert np.degrees(Rotation.from_matrix(off).magnitude()).max() < 0.3
    assert pan.focal == pytest.approx(700, rel=0.03)
    assert 0.7 < pan.explained < 0.9
    assert pan.travel == pytest.approx(700 * np.radians(26), rel=0.05)


def test_a_camera_that_walks_is_no_pan() -> None:
    names, places, matches, _ = pan_matches(14, 0.1, 0.0)
    pan = solve_pan(names, places, matches, SIZE, 700.0)
    assert pan is not None
    assert pan.explained < 0.5
    assert solve_pan(names, places, {}, SIZE, 700.0) is None


def test_rays_of_a_bent_lens() -> None:
    flat = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2))
    bent = 500 * flat * (1 - 0.1 * np.square(flat).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(rays(bent, 500, -0.1)[:, :2], flat, atol=1e-5)


def test_a_film_of_a_pan(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """It becomes a capture that opens, and is called by its name."""
    cameras = [
        Camera.looking_at([0, -4, 0.5], [x, 0, 0.2], up=[0, 0, 1], fov_x=0.7, width=240, height=180)
        for x in np.linspace(-0.7, 0.7, 10)
    ]
    film = write_film(tmp_path / "pan.mp4", [drawn(camera, 0, Board())[0] for camera in cameras], rate=10)
    prepare([film], tmp_path / "out")
    assert re.search("(?s)turns on the spot.*10 images, 10 of 10 cameras placed", capfd.readouterr().out)
    data = load_dataset(tmp_path / "out")
    views = sorted((*data.train, *data.test), key=lambda view: view.time)
    found = np.stack([view.camera.T_cam_world[2, :3] for view in views])
    true = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    turned = np.degrees(np.arccos(np.clip((found[1:] * found[:-1]).sum(axis=1), -1, 1)))
    assert turned == pytest.approx(np.degrees(np.arccos((true[1:] * true[:-1]).sum(axis=1))), rel=0.15)


def test_what_a_hand_does_not_do() -> None:
    cameras = walk(20, 320, 240)
    places, axes = (np.stack(each) for each in zip(*((c.position, c.T_cam_world[2, :3]) for c in cameras), strict=True))
    points = np.random.default_rng(0).normal(size=(50, 3))
    names, fast = ([f"{step * i:08d}.jpg" for i in range(20)] for step in (100, 20))
    assert "a second" in path_faults(places, axes, points, fast)[0][0]
    assert path_faults(places, axes, points, names) == []
    jump = places + np.where(np.arange(20) >= 9, 3.0, 0.0)[:, None]
    assert [i for what, i in path_faults(jump, axes, points, names) if "step" in what] == [9]
    turned = axes.copy()
    turned[14:] = turned[14:] @ Rotation.from_euler("z", 50, degrees=True).as_matrix()
    assert [i for what, i in path_faults(places, turned, points, names) if "turn" in what] == [14]
    back = places.copy()
    back[12:] = places[10:2:-1]
    assert [i for what, i in path_faults(back, axes, points, names) if "back" in what] == [11]
    stalled = places.copy()
    stalled[5:9] = places[5]
    assert [i for what, i in path_faults(stalled, axes, points, names) if "stalls" in what] == [5]
    shaken = places[0] + np.random.default_rng(1).normal(size=(20, 3)) * 1e-4  # of a tripod
    assert path_faults(shaken, axes, points, names) == []
    pan = places[0] + np.where(np.arange(20) % 7 < 3, 1e-16, 0.0)[:, None]
    assert path_faults(pan, axes, points, names) == []


def test_the_part_that_fits() -> None:
    names = [f"{i}" for i in range(20)]
    placed = [f"{i}" for i in (0, 1, 2, 8, 9, 11, 12, 14, 19)]
    assert longest_part(names, placed) == ["8", "9", "11", "12", "14"]
    assert longest_part(names, names) == names


def test_nearest_descriptors() -> None:
    rng = np.random.default_rng(0)
    one = np.abs(rng.normal(size=(40, 128))).astype(np.float32)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other = one[::-1].copy()
    other[:5] = one[3]  # 36 to 39 are gone, and five features look like 3
    found = nearest(one, other)
    assert {(int(a), int(b)) for a, b in found if 4 <= a < 35} == {(a, 39 - a) for a in range(4, 35)}
    assert 3 not in found[:, 0]
    assert len(nearest(one[:1], other)) == 0


@pytest.mark.parametrize(("rate", "seconds", "images"), [(24, 4.3, 24), (24, 6, 12), (30, 20, 10), (60, 3, 30)])
def test_a_short_film_gives_more_images(rate: float, seconds: float, images: float) -> None:
    film = SimpleNamespace(rate=float(rate), seconds=float(seconds), keeps_all=False)
    assert images_per_second([film], None) == images  # type: ignore[list-item]
