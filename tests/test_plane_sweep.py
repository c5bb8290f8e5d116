"""Surfaces of what stands still, by a plane sweep between still cameras."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lapgs_wgpu.data import Dataset, View
from lapgs_wgpu.data.plane_sweep import _stills, _sweep, still_surface
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.initial_points import initial_points
from lapgs_wgpu.train.presets import load_config

NORMAL, DISTANCE = np.array([0.2, 0.1, 1.0]), 4.0  # of the wall: NORMAL . point = DISTANCE
TEXTURE = ndimage.gaussian_filter(np.random.default_rng(0).random((200, 200, 3)), (1.5, 1.5, 0), mode="wrap")
TEXTURE = (TEXTURE - TEXTURE.min()) / np.ptp(TEXTURE)


def wall(camera: Camera) -> NDArray[np.uint8]:
    """A camera's image of the wall, which has a texture of 10 x 10 world units."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.linalg.solve(camera.K, np.stack([x.ravel(), y.ravel(), np.ones(x.size)])).T @ camera.T_cam_world[:3, :3]
    points = camera.position + rays * ((DISTANCE - NORMAL @ camera.position) / (rays @ NORMAL))[:, None]
    at = (points[:, :2] + 5.0).T * 20.0
    colors = [ndimage.map_coordinates(TEXTURE[..., c], at, order=1, mode="grid-wrap") for c in range(3)]
    return np.round(255 * np.stack(colors, axis=-1)).astype(np.uint8).reshape(camera.height, camera.width, 3)


def rig(count: int = 6, moments: int = 9) -> Dataset:
    """Cameras beside and above each other before the wall; something white passes by."""
    views = []
    for c in range(count):
        eye = np.array([0.25 * (c % 3) - 0.25, 0.25 * (c // 3), 0.0])
        camera = Camera.looking_at(eye, [0.0, 0.1, 4.0], up=[0, -1, 0], fov_x=0.8, width=80, height=60)
        still = wall(camera)
        for n in range(moments):

            def image(still: NDArray[np.uint8] = still, n: int = n) -> NDArray[np.uint8]:
                shown = still.copy()
                shown[20:40, 8 * n : 8 * n + 12] = 255
                return shown

            views.append(View(f"cam{c:02}_{n:04}", camera, n / (moments - 1), "made up", image))
    return Dataset("wall", tuple(views), (), depths=(2.0, 8.0))


def test_the_surface_is_where_the_wall_is() -> None:
    found = still_surface(rig())
    assert found is not None
    off = np.abs(found.points @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)
    assert found.share > 0.75
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.99) < 0.1
    at = (found.points[:, :2].T + 5.0) * 20.0
    true = np.stack([ndimage.map_coordinates(TEXTURE[..., c], at, order=1, mode="grid-wrap") for c in range(3)], 1)
    assert np.abs(found.colors - true).mean() < 0.03


def test_no_depth_is_beyond_the_stated_ones() -> None:
    """Where the wall is behind the furthest plane, that plane looks most like it."""
    stills = _stills(rig(moments=2))
    planes = np.linspace(1 / 3.9, 1 / 2, 4)
    for still in stills:
        inverse = _sweep(still, [other for other in stills if other is not still], planes)
        found = inverse[np.isfinite(inverse)]
        assert len(found)
        assert found.min() >= planes[0]


@pytest.mark.nightly
def test_what_looks_the_same_everywhere_has_no_depth() -> None:
    data = rig(moments=2)
    blank = [dataclasses.replace(view, pixels=lambda: np.full((60, 80, 3), 90, np.uint8)) for view in data.train]
    found = still_surface(dataclasses.replace(data, train=tuple(blank)))
    assert found is not None
    assert (len(found.points), found.share) == (0, 0.0)


@pytest.mark.parametrize("lacking", ["cameras", "depths", "stillness"])
def test_other_captures_have_none(lacking: str) -> None:
    data = rig(2 if lacking == "cameras" else 4, 3)
    if lacking == "depths":
        data = dataclasses.replace(data, depths=None)
    if lacking == "stillness":
        own = [dataclasses.replace(view, camera=dataclasses.replace(view.camera)) for view in data.train]
        data = dataclasses.replace(data, train=tuple(own))
    assert still_surface(data) is None


@pytest.mark.nightly
def test_a_training_starts_from_it() -> None:
    """As large a share of the points as of the pixels lies on the surface."""
    data, config = rig(), load_config("neu3d-tiny").points
    points, colors, scales = initial_points(config, data, 0)
    found = still_surface(data)
    assert found is not None
    assert points.shape == colors.shape == (config.count, 3)
    off = np.abs(points @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)
    assert (off < 0.1).mean() == pytest.approx(found.share, abs=0.1)
    assert scales.shape == (config.count,)
    again = initial_points(config, rig(), 0)
    np.testing.assert_array_equal(again[0], points)
