"""The first Gaussians of a training, in the order of a Morton curve."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.data.initial_gaussians import first_points, initial_scales, limit_optical_depth
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.train.config import PointsConfig


def initial_points(
    config: PointsConfig, dataset: Dataset, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The first Gaussians (data/initial_gaussians): points (N, 3), colors (N, 3) and scales (N,)."""
    points, colors = first_points(dataset, config.count, config.box, seed)
    scales = initial_scales(points)
    # Published figures of D-NeRF start from a fog, which the empty background there soon lifts.
    if dataset.cloud is not None or dataset.depths is not None:
        scales = limit_optical_depth(points, scales, config.opacity, dataset.cameras)
    order = morton_order(torch.from_numpy(points)).numpy()
    return points[order], colors[order], scales[order]
