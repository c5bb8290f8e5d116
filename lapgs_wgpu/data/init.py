"""Where Gaussians start: the capture's own points, or random ones; and scales from the distances between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lapgs_wgpu.data.cloud import evenly_chosen, in_view, points_in_view
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.splat.camera import Camera

NEIGHBOURS = 3
MIN_SCALE = float(np.sqrt(1e-7))  # 3DGS's bound on the squared distance: keeps the log-scale of duplicate points finite
THICKEST = 1.0  # optical depth of the first Gaussians: 1 / e of the light passes through all of them


def first_points(
    dataset: Dataset, count: int, box: float, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Means (n, 3) in world units and colours (n, 3) RGB in [0, 1] of the first Gaussians of a training.

    The capture's cloud, at most `count` of its points; without one `count` random points, mid-grey: where the cameras'
    views overlap if the capture says how deep they see, else in [-box, box]^3.
    """
    if dataset.cloud is not None:
        return dataset.cloud.at_most(count, seed)
    if dataset.depths is None:
        return random_points(count, -box, box, seed)
    means = points_in_view(dataset.cameras, *dataset.depths, count, seed).astype(np.float32)
    return means, np.full_like(means, 0.5)


def random_points(n: int, low: float, high: float, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """n points drawn uniformly from the cube [low, high]^3: means (n, 3) in world units, colours (n, 3) RGB in [0, 1].

    All colours are mid-grey, as in 3DGS (but for its noise of 1/255): nothing is known about them yet.
    """
    if n < 1 or not low < high:
        raise ValueError(f"random_points needs n >= 1 and low < high, got n = {n}, low = {low}, high = {high}")
    means = np.random.default_rng(seed).uniform(low, high, (n, 3)).astype(np.float32)
    return means, np.full((n, 3), 0.5, dtype=np.float32)


def initial_scales(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Root mean squared distance to the 3 nearest neighbours, world units, at least MIN_SCALE.

    points: (n, 3), n >= 1. Returns (n,). Up to three points use the neighbours there are; a single one gets 1.
    Source: 3DGS (Kerbl et al. 2023), section 5.2, which takes the mean squared distance in its code.
    """
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 1:
        raise ValueError(f"initial_scales needs points of (n, 3) with n >= 1, got {points.shape}")
    if len(points) == 1:
        return np.ones(1, dtype=np.float32)
    tree = cKDTree(points)
    nth_nearest = range(2, min(NEIGHBOURS + 1, len(points)) + 1)  # the first is the point itself
    distances, _ = tree.query(points, k=nth_nearest)
    return np.maximum(np.sqrt(np.mean(distances**2, axis=1)), MIN_SCALE).astype(np.float32)


def see_through(
    points: NDArray[np.floating], scales: NDArray[np.float32], opacity: float, cameras: Sequence[Camera]
) -> NDArray[np.float32]:
    """The scales (n,) of Gaussians at points (n, 3), world units, all lowered alike where they would hide each other.

    A cloud of a scene's surfaces is one layer deep. Points all over a volume are many, and as large as the gaps between
    them they are a fog: most get no light and no gradient, and training paints a blurred picture on its outside.
    opacity: of each. Holds for the median of the cameras.
    """
    thickness = [_optical_depth(points, scales, opacity, camera) for camera in evenly_chosen(cameras)]
    return (scales * min(1.0, (THICKEST / max(float(np.median(thickness)), 1e-9)) ** 0.5)).astype(np.float32)


def _optical_depth(points: NDArray[np.floating], scales: NDArray[np.floating], opacity: float, camera: Camera) -> float:
    """Of all Gaussians that a camera sees together, the mean over its image."""
    depths, inside = in_view(points, camera)
    radii = scales[inside] / depths[inside]
    area = 2 * np.pi * radii**2 * camera.K[0, 0] * camera.K[1, 1] / (camera.width * camera.height)
    return float((opacity * np.minimum(area, 1.0)).sum())
