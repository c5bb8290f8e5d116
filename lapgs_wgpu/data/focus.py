"""What the cameras of a capture look at, and how far apart they stand."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import in_view
from lapgs_wgpu.splat.camera import Array, Camera

PARALLEL = 1e-2  # mean squared sine between optical axes below which they do not determine a point
FAR_APART = 30.0  # degrees between neighbouring still cameras, beyond which none confirms another one's depths


def spread(cameras: Sequence[Camera]) -> float:
    """The largest distance of a camera from the mean of all; 0 where rounding alone tells their places apart."""
    positions = np.stack([camera.position for camera in cameras])
    largest = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    return largest if largest > 1e-9 * np.abs(positions).max() else 0.0


def are_parallel(cameras: Sequence[Camera]) -> bool:
    """Whether all look in one direction, as one camera that stands still does: their axes meet nowhere."""
    return bool(np.linalg.eigvalsh(_across(cameras).mean(axis=0))[0] < PARALLEL)


def directions(cameras: Sequence[Camera], focus: NDArray[np.floating]) -> Array:
    """(N, 3) unit vectors from what the cameras look at (3,) to each of them."""
    rays = np.stack([camera.position - focus for camera in cameras])
    return rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)


def degrees_apart(cameras: Sequence[Camera], focus: NDArray[np.floating]) -> float:
    """The median angle between a camera and the nearest other one, seen from what they look at (3,); 0 of one."""
    rays = directions(cameras, focus)
    nearest = np.sort(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1))), axis=1)[:, 1:2]
    return float(np.median(nearest)) if nearest.size else 0.0


def focus_of(cameras: Sequence[Camera], *, origin: bool) -> Array:
    """(3,) the point with the least sum of distances from the optical axes, so that outliers hardly move it.

    Parallel axes determine no point. The result is then a point one `spread` (1 where that is 0) in front of the
    cameras. origin: whether the scene is likely to lie around the origin; that is then the result if half of the
    cameras see it.
    """
    centers = np.stack([camera.position for camera in cameras])
    ahead = np.mean([camera.T_cam_world[2, :3] for camera in cameras], axis=0)
    guess = centers.mean(axis=0) + (spread(cameras) or 1.0) * ahead
    if are_parallel(cameras):
        middle = np.zeros((1, 3))
        seen = origin and np.mean([in_view(middle, camera)[1][0] for camera in cameras]) >= 0.5
        return middle[0] if seen else guess
    across = _across(cameras)
    point, weights = guess, np.full(len(cameras), 1 / len(cameras))
    for _ in range(20):
        matrix = np.einsum("n,nij->ij", weights, across)
        # Regularize towards the guess: reweighting may leave parallel axes alone.
        faint = 1e-6 * np.trace(matrix) * np.eye(3)
        point = np.linalg.solve(matrix + faint, np.einsum("n,nij,nj->i", weights, across, centers) + faint @ guess)
        misses = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centers), axis=1)
        floor = 1e-3 * float(np.median(np.linalg.norm(point - centers, axis=1))) + 1e-12
        weights = 1 / np.maximum(misses / floor, 1.0)
    return point


def _across(cameras: Sequence[Camera]) -> Array:
    """(N, 3, 3) the projections onto the planes across the optical axes."""
    ahead = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    return np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
