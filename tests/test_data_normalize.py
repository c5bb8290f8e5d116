"""Scenes in D-NeRF's layout of any size and place: which keep their coordinates, and where others are brought."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import synthetic as toys
from helpers.captures import write_points
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu import cli
from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.cloud import views_of
from lapgs_wgpu.data.normalize import cube_in_view
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.motion.scene import load
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import initial_points

FAR = np.array([100.0, -70.0, 30.0])
RNG = np.random.default_rng(0)


def around(count: int, target: Sequence[float] = (0, 0, 0), distance: float = 4.0, fov_x: float = 0.69) -> list[Camera]:
    """Cameras on a sphere about the target, which they look at."""
    return [
        Camera.looking_at(distance * camera.position / toys.CAMERA_RADIUS + target, list(target), up=[0, 0, 1],
                          fov_x=fov_x, width=16, height=12)
        for camera in toys.cameras(count, 0, size=16)
    ]  # fmt: skip


def moved(camera: Camera, scale: float, offset: NDArray[np.float64] = FAR) -> Camera:
    """The camera in a capture that was scaled first and moved afterwards."""
    T = camera.T_cam_world.copy()
    T[:3, 3] = -T[:3, :3] @ (scale * camera.position + offset)
    return Camera(camera.K, T, camera.width, camera.height)


def turned(camera: Camera) -> Camera:
    """The camera looking the other way."""
    T = np.diag([1.0, -1, -1, 1]) @ camera.T_cam_world
    return Camera(camera.K, T, camera.width, camera.height)


def write_scene(folder: Path, cameras: Sequence[Camera], cloud: NDArray[np.float64] | None = None) -> Path:
    """The cameras in D-NeRF's layout, the last one to test on, each with a picture of noise and a time of its own."""
    folder.mkdir(parents=True)
    frames = []
    for i, camera in enumerate(cameras):
        noise = RNG.integers(0, 256, (camera.height, camera.width, 4), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{i:03d}.png")
        pose = np.linalg.inv(camera.T_cam_world) @ np.diag([1.0, -1, -1, 1])
        time = i / max(len(cameras) - 2, 1) if i < len(cameras) - 1 else 0.5
        frames.append({"file_path": f"{i:03d}", "transform_matrix": pose.tolist(), "time": time})
    fov_x = 2 * np.arctan(cameras[0].width / 2 / cameras[0].K[0, 0])
    for split, chosen in (("train", frames[:-1]), ("test", frames[-1:])):
        data = {"camera_angle_x": fov_x, "frames": chosen}
        (folder / f"transforms_{split}.json").write_text(json.dumps(data))
    if cloud is not None:
        write_points(folder / "fused.ply", cloud, RNG.integers(0, 256, cloud.shape))
    return folder


def same_cameras(a: Dataset, b: Dataset, atol: float) -> None:
    for one, other in zip(a.train + a.test, b.train + b.test, strict=True):
        np.testing.assert_allclose(one.camera.T_cam_world, other.camera.T_cam_world, atol=atol)
        np.testing.assert_array_equal(one.camera.K, other.camera.K)


def test_the_standard_scenes_keep_their_coordinates(tmp_path: Path) -> None:
    taken = around(12)
    cube = cube_in_view(taken)
    assert cube is not None
    assert cube.half == pytest.approx(1.3, rel=0.02)
    np.testing.assert_allclose(cube.center, 0, atol=1e-5)
    data = load_dataset(write_scene(tmp_path / "toy", taken))
    assert data.normalization is None
    for view, camera in zip(data.train, taken, strict=False):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-12)


@pytest.mark.parametrize("scale", [0.01, 50.0])
def test_any_scale_and_place_starts_equal(tmp_path: Path, scale: float) -> None:
    taken = around(12, target=(0, 0, 0.8), distance=6.0, fov_x=0.87)
    here = load_dataset(write_scene(tmp_path / "here", taken))
    there = load_dataset(write_scene(tmp_path / "there", [moved(camera, scale) for camera in taken]))
    assert here.normalization is not None
    assert there.normalization is not None
    assert there.normalization.scale * scale == pytest.approx(here.normalization.scale, rel=1e-9)
    np.testing.assert_allclose(there.normalization.center, scale * here.normalization.center + FAR, rtol=1e-9)
    same_cameras(here, there, 1e-9 / min(scale, 1))
    assert there.extent == pytest.approx(here.extent, rel=1e-9)
    config = load_config("tiny")
    for one, other in zip(initial_points(config.points, here, 0), initial_points(config.points, there, 0), strict=True):
        np.testing.assert_array_equal(one, other)
    seen = views_of(initial_points(config.points, there, 0)[0].astype(np.float64), there.cameras)
    assert (seen > 0).mean() > 0.95, "the first Gaussians lie where the cameras look"


def test_a_few_stray_cameras_change_nothing() -> None:
    """Some look away, some stand far off: the scene is where most look."""
    taken = around(50)
    for i in range(0, 50, 5):
        taken[i] = Camera.looking_at(taken[i].position, RNG.normal(size=3) * 9, up=[0, 0, 1], fov_x=0.69, width=16,
                                     height=12)  # fmt: skip
    taken[3] = moved(taken[3], 1000.0, np.zeros(3))
    taken[4] = turned(taken[4])
    cube = cube_in_view(taken)
    assert cube is not None
    assert cube.fits


def test_a_still_camera(tmp_path: Path) -> None:
    """Its lines of sight meet nowhere: the scene is at the origin if it sees that, else in front of it."""
    (camera,) = around(1)
    cube = cube_in_view([camera] * 5)
    assert cube is not None
    assert cube.fits
    away = moved(camera, 1.0)
    data = load_dataset(write_scene(tmp_path / "toy", [away] * 4))
    points = initial_points(load_config("tiny").points, data, 0)[0].astype(np.float64)
    assert (views_of(points, data.cameras[:1]) > 0).mean() > 0.5


def test_cameras_that_look_outward(tmp_path: Path) -> None:
    """Nothing tells how far away it is what they see."""
    inside = [moved(turned(camera), 0.1, np.zeros(3)) for camera in around(9)]
    assert cube_in_view(inside) is None
    data = load_dataset(write_scene(tmp_path / "toy", inside))
    assert data.normalization is None
    (warning,) = data.warnings
    assert "transforms_train.json" in warning


@pytest.mark.parametrize("half", [1.3, 2.5])
def test_a_random_cloud_is_ignored(tmp_path: Path, half: float) -> None:
    taken = around(6)
    plain = load_dataset(write_scene(tmp_path / "plain", taken))
    with_cloud = load_dataset(write_scene(tmp_path / "cloud", taken, RNG.uniform(-half, half, (2000, 3))))
    assert with_cloud.cloud is None
    assert with_cloud.normalization is None
    same_cameras(plain, with_cloud, 0)


def test_a_cloud_of_surfaces_is_where_gaussians_start(tmp_path: Path) -> None:
    """It decides about the box, too: cameras see more than the scene."""
    directions = RNG.normal(size=(3000, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    data = load_dataset(write_scene(tmp_path / "here", around(6), sphere))
    assert data.normalization is None
    assert data.cloud is not None
    np.testing.assert_allclose(data.cloud.points, sphere, atol=1e-6)

    far = [moved(camera, 50) for camera in around(6)]
    data = load_dataset(write_scene(tmp_path / "there", far, 50 * sphere + FAR))
    assert data.normalization is not None
    assert data.cloud is not None
    assert data.normalization.scale == pytest.approx(1.3 / 50, rel=0.03)
    np.testing.assert_allclose(data.cloud.points, 1.3 * sphere, atol=0.08)
    with pytest.raises(InputError, match=r"fused\.ply.* 0 % of its points"):
        load_dataset(write_scene(tmp_path / "wrong", far, sphere))


def test_the_placement_is_told_kept_and_used_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_scene(tmp_path / "toy", [moved(camera, 50) for camera in around(6)])
    run = tmp_path / "run"
    fast = ["--steps", "2", "--points.count", "50", "--points.box", "1.7", "--field", "static"]
    assert cli.train_command(["tiny", "--data", str(folder), "--out", str(run), *fast]) == 0
    assert "normalization" in capsys.readouterr().out
    metrics = json.loads((run / "metrics.json").read_text())
    scene = load(run / "checkpoint.ply")
    assert "placement" in scene.metadata
    means = scene.parameters["means"]
    assert 1.4 < means.detach().abs().max() < 1.8, "points.box is in world units"
    assert cli.train_command(["--eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["views"] == metrics["views"]
