"""Initial points and scales."""

import dataclasses
from itertools import product

import numpy as np
import pytest
import torch

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.initial_gaussians import MIN_SCALE, initial_scales, limit_optical_depth
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import Rendering, rasterize
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import INITIAL_OPACITY, initial_points

# A room that eight cameras film from one side.
CAMERAS = [
    Camera.looking_at([x, -2.2, z], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=84, height=64)
    for x, z in product((-0.5, -0.2, 0.2, 0.6), (0.3, 0.6))
]
VIEWS = tuple(
    View(f"view_{i}", camera, 0.0, "memory", lambda: np.zeros((64, 84, 3), np.uint8))
    for i, camera in enumerate(CAMERAS)
)
ROOM = Dataset("room", VIEWS, VIEWS[:1], depths=(0.9, 3.7))


def test_scales_match_all_pairs() -> None:
    points = np.random.default_rng(3).uniform(-1.0, 2.0, (200, 3)).astype(np.float32)
    squared = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=-1)
    expected = np.sqrt(np.sort(squared, axis=1)[:, 1:4].mean(axis=1))
    scales = initial_scales(points)
    assert scales.dtype == np.float32
    np.testing.assert_allclose(scales, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("points", "scales"),
    [
        ([[5, 5, 5]], [1]),
        ([[0, 0, 0], [3, 4, 0]], [5, 5]),
        ([[0, 0, 0], [1, 0, 0], [3, 0, 0]], [np.sqrt(5), np.sqrt(2.5), np.sqrt(6.5)]),
        ([[1, 2, 3]] * 7, [MIN_SCALE] * 7),
        ([[0, 0, 0]] * 2 + [[0, 0, 3]] * 2, [np.sqrt(6)] * 4),
    ],
)
def test_few_and_coinciding_points(points: list[list[float]], scales: list[float]) -> None:
    np.testing.assert_allclose(initial_scales(np.array(points, dtype=np.float32)), np.array(scales), rtol=1e-6)


def first_picture(dataset: Dataset, device: Device) -> tuple[Rendering, torch.Tensor]:
    """What the first camera sees of a training's first Gaussians, and the gradient of its brightness by opacities."""
    config = load_config("neu3d-tiny").points
    points, colors, scales = (torch.from_numpy(array) for array in initial_points(config, dataset, 0))
    opacities = torch.full((len(points),), INITIAL_OPACITY, requires_grad=True)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(points), 4)
    drawn = rasterize(points, quats, scales[:, None].expand(-1, 3), opacities, colors, CAMERAS[0], device=device)
    drawn.image.sum().backward()
    assert opacities.grad is not None
    return drawn, opacities.grad


def test_random_points_hide_nothing(device: Device) -> None:
    """As large as the gaps between them they were a fog: all light stayed in it, and half of them had no gradient. A
    training of a room painted a blur on its outside, from which a moving one ran away into the black."""
    drawn, gradient = first_picture(ROOM, device)
    assert 0.4 < drawn.alpha.mean().item() < 0.8
    visible = drawn.radii > 0
    assert int(visible.sum()) > 5000
    assert float((gradient[visible] != 0).float().mean()) > 0.9


def test_a_cloud_of_surfaces_keeps_its_sizes() -> None:
    x, z = np.meshgrid(np.linspace(-0.7, 0.7, 60), np.linspace(-0.5, 0.5, 40))
    wall = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3).astype(np.float32)
    scales = initial_scales(wall)
    np.testing.assert_array_equal(limit_optical_depth(wall, scales, 0.1, CAMERAS), scales)
    dataset = dataclasses.replace(ROOM, cloud=Cloud(wall, wall))
    points, _, kept = initial_points(load_config("neu3d-tiny").points, dataset, 0)
    np.testing.assert_array_equal(kept, initial_scales(points))  # in another order
    np.testing.assert_array_equal(np.sort(kept), np.sort(scales))


def test_points_around_a_camera_count_as_one_picture_each() -> None:
    """However near they are; those behind it do not count."""
    near = np.float32(CAMERAS[0].position + 1e-4 * CAMERAS[0].T_cam_world[2, :3])
    behind = np.float32(CAMERAS[0].position - 0.1 * CAMERAS[0].T_cam_world[2, :3])
    scales = np.full(40, 0.1, np.float32)
    thinned = limit_optical_depth(np.tile(near, (40, 1)), scales, 0.1, CAMERAS[:1])
    np.testing.assert_allclose(thinned, 0.1 * (40 * 0.1) ** -0.5, rtol=1e-6)
    np.testing.assert_array_equal(limit_optical_depth(np.tile(behind, (40, 1)), scales, 0.1, CAMERAS[:1]), scales)
