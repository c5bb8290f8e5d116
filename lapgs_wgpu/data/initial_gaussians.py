"""Initial Gaussians: means from the capture's cloud or random ones, and scales from the distances between them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lapgs_wgpu.data.cloud import CAMERA_SAMPLES, in_view, points_in_view
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.splat.camera import Camera

NEIGHBOURS = 3
MIN_SCALE = float(np.sqrt(1e-7))  # 3DGS's bound on the squared distance: keeps the log-scale of duplicate points finite
MAX_OPTICAL_DEPTH = 1.0  # of the initial Gaussians: 1 / e of the light passes through all of them


def first_points(
    dataset: Dataset, count: int, box: float, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return means (n, 3), world units, and colors (n, 3), RGB in [0, 1], of the initial Gaussians. Both float32.

    These are at most `count` points of the capture's cloud; without a cloud, `count` random points, mid-gray: where the
    cameras' views overlap if the capture has depths, else in [-box, box]^3.
    """
    if dataset.cloud is not None:
        return dataset.cloud.at_most(count, seed)
    if dataset.depths is None:
        means = np.random.default_rng(seed).uniform(-box, box, (count, 3))
    else:
        means = points_in_view(dataset.cameras, *dataset.depths, count, seed)
    return means.astype(np.float32), np.full((count, 3), 0.5, np.float32)


def initial_scales(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the root mean squared distance to the 3 nearest neighbours, world units, at least MIN_SCALE.

    points: (n, 3), n >= 1. Returns (n,). Up to three points use all their neighbours; a single point gets 1.
    Source: 3DGS (Kerbl et al. 2023), section 5.2, which takes the mean squared distance in its code.
    """
    if len(points) == 1:
        return np.ones(1, dtype=np.float32)
    tree = cKDTree(points)
    nth_nearest = range(2, min(NEIGHBOURS + 1, len(points)) + 1)  # the first is the point itself
    distances, _ = tree.query(points, k=nth_nearest)
    return np.maximum(np.sqrt(np.mean(distances**2, axis=1)), MIN_SCALE).astype(np.float32)


def limit_optical_depth(
    points: NDArray[np.floating], scales: NDArray[np.float32], opacity: float, cameras: Sequence[Camera]
) -> NDArray[np.float32]:
    """Scale all Gaussians down by one factor if their optical depth in the median camera exceeds MAX_OPTICAL_DEPTH.

    A cloud of surfaces is one layer deep. Random points fill a volume; as large as the gaps between them, they occlude
    each other: most get no gradient, and training fits a blurred image on the outside of the volume.

    points: (n, 3), world units. scales: (n,), world units. opacity: of each Gaussian. Returns (n,) scales.
    """
    optical_depths = []
    for camera in evenly(cameras, CAMERA_SAMPLES):
        depths, inside = in_view(points, camera)
        radii = scales[inside] / depths[inside]
        area = 2 * np.pi * radii**2 * camera.K[0, 0] * camera.K[1, 1] / (camera.width * camera.height)
        optical_depths.append(float((opacity * np.minimum(area, 1.0)).sum()))
    factor = min(1.0, (MAX_OPTICAL_DEPTH / max(float(np.median(optical_depths)), 1e-9)) ** 0.5)
    return (scales * factor).astype(np.float32)
