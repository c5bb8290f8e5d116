"""The scene that is timed: a ball of Gaussians, the same for every rasteriser that is compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu import Camera

BALL_RADIUS, CAMERA_DISTANCE, FOV_X = 1.3, 4.0, 0.69
MEAN_SCALE, SPREAD = 0.02, 0.3  # standard deviations are log-normal; the mean shrinks so that the ball stays as full


def make_scene(count: int, size: int) -> tuple[dict[str, NDArray[np.float32]], Camera]:
    """Activated Gaussians as `rasterize` takes them (colors: RGB), and a camera of size x size pixels."""
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = direction * (BALL_RADIUS * rng.random((count, 1)) ** (1 / 3))
    mean_scale = MEAN_SCALE * (50_000 / count) ** (1 / 3)
    scales = np.exp(rng.normal(np.log(mean_scale) - SPREAD**2 / 2, SPREAD, (count, 3)))
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = rng.uniform(0.05, 0.95, count)
    colors = rng.random((count, 3))
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    camera = Camera.looking_at([0, 0, -CAMERA_DISTANCE], [0, 0, 0], up=[0, -1, 0], fov_x=FOV_X, width=size, height=size)
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}, camera


def save_scene(path: Path, arrays: dict[str, NDArray[np.float32]], camera: Camera) -> None:
    """Write it as .npz, with K (3, 3), T_cam_world (4, 4), width and height, for other rasterisers to read."""
    K, T_cam_world = camera.K.astype(np.float32), camera.T_cam_world.astype(np.float32)
    np.savez(path, K=K, T_cam_world=T_cam_world, width=camera.width, height=camera.height, **arrays)
