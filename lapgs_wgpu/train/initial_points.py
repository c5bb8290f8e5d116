"""The first Gaussians of a training, in the order of a Morton curve."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.data.initial_gaussians import first_points, initial_scales, limit_optical_depth
from lapgs_wgpu.data.plane_sweep import still_surface
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.train.config import PointsConfig

INITIAL_OPACITY = 0.1


def initial_points(
    config: PointsConfig, dataset: Dataset, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The first Gaussians: points (N, 3), colors (N, 3) and scales (N,).

    Without a cloud, the cameras of a rig tell where what stands still is (data/plane_sweep): as large a share of the
    points as of the pixels lies there. The others, and those of other captures, lie as data/initial_gaussians says.
    """
    points, colors = first_points(dataset, config.count, config.box, seed)
    if dataset.cloud is None and (surface := still_surface(dataset)) is not None:
        known = min(round(surface.share * len(points)), len(surface.points))
        chosen = np.random.default_rng(seed).choice(len(surface.points), known, replace=False)
        points[:known], colors[:known] = surface.points[chosen], surface.colors[chosen]
    scales = initial_scales(points)
    # Published figures of D-NeRF start from a fog, which the empty background there soon lifts.
    if dataset.cloud is not None or dataset.depths is not None:
        scales = limit_optical_depth(points, scales, INITIAL_OPACITY, dataset.cameras)
    order = morton_order(torch.from_numpy(points)).numpy()
    return points[order], colors[order], scales[order]
