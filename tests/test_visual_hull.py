"""What moves between still cameras all around: its places and its colors."""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data import Dataset, View
from lapgs_wgpu.discovery.tracks import find_tracks
from lapgs_wgpu.discovery.visual_hull import POINTS, hull_points
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.plan import camera_layout

RADIUS, COLOR, TIMES, HALF = 0.2, (0.8, 0.3, 0.1), np.arange(13) / 12, 1.3


def center(time: float) -> NDArray[np.float64]:
    """Of a ball, which falls, and then rests."""
    return np.array([1.2 * min(time, 0.7) - 0.6, 0.1, 0.5 - 1.5 * min(time, 0.7) ** 2])


def shot(camera: Camera, time: float) -> NDArray[np.uint8]:
    """The ball before a checkered gray."""
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels, depths = camera.project(center(time)[None])
    inside = np.hypot(x + 0.5 - pixels[0, 0], y + 0.5 - pixels[0, 1]) < RADIUS * camera.K[0, 0] / depths[0]
    gray = (100 + 20 * ((x // 8 + y // 8) % 2))[..., None]
    return np.where(inside[..., None], 255 * np.array(COLOR), gray).astype(np.uint8)


def rig(*, circle: bool = True) -> Dataset:
    """Nine cameras on a circle, or on a sixth of it."""
    views = []
    for c, angle in enumerate(np.linspace(0, 2 * np.pi if circle else np.pi / 3, 9, endpoint=not circle)):
        eye = [3 * np.cos(angle), 3 * np.sin(angle), 0.6 + 0.2 * (c % 3)]
        camera = Camera.looking_at(eye, [0, 0, 0], up=[0, 0, 1], fov_x=1.0, width=80, height=60)
        for n, time in enumerate(TIMES.tolist()):
            views.append(View(f"cam{c:02}_{n:04}", camera, time, "made up", partial(shot, camera, time)))
    return Dataset("ball", tuple(views), ())


def test_a_ball_is_found_and_followed() -> None:
    dataset = rig()
    assert camera_layout(dataset) == "static cameras all around"
    assert camera_layout(rig(circle=False)) == "static cameras"
    dark = [replace(view, load=lambda: np.zeros((60, 80, 3), np.uint8)) for view in dataset.train[:5]]
    clouds = hull_points(replace(dataset, train=(*dark, *dataset.train[5:])), HALF)
    for time, cloud in zip(TIMES, clouds.clouds, strict=True):
        assert np.linalg.norm(cloud.positions - center(time), axis=1).max() < 1.5 * RADIUS
        assert len(cloud.scores) > 0.9 * POINTS  # fewer than its cells
        assert np.quantile(np.abs(cloud.colors - COLOR), 0.8) < 0.01  # the rim may be gray
    tracks = find_tracks(clouds)
    assert tracks is not None
    assert np.abs(tracks.paths.mean(axis=1) - [center(time) for time in TIMES]).max() < 0.3 * RADIUS
