"""What a training starts with: initial points, or what motion discovery found (lapgs_wgpu/discovery)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from lapgs_wgpu.data.initial_gaussians import first_points, initial_scales, limit_optical_depth
from lapgs_wgpu.data.plane_sweep import still_surface
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import Config, PointsConfig

INITIAL_OPACITY = 0.1
MOST_PIXELS = 0.5  # share from which on random points would only be a fog before the surfaces
# Learning rates at which a field keeps what discovery fitted; at higher ones Adam's noise undoes the fit.
MAX_HASH_RATE, MAX_MLP_RATE = 5e-3, 1e-3


@dataclass(frozen=True)
class Start:
    """What a training starts with: the first Gaussians, and the field.

    warm_up_steps: number of the first steps without motion. ramp_steps: of those over which the learning rates rise
    from 0. field_fitted: 0, or the field knows nearly all that moves: its rates then stay below this share of the
    highest (`max_field_rates`), and the acceleration loss is left out.
    corrections: of the training cameras; None where they are as given. summary:
    what discovery found, a sentence; None without discovery. seconds: that discovery took.
    """

    scene: Scene4D
    warm_up_steps: int = 0
    ramp_steps: int = 0
    field_fitted: float = 0.0
    corrections: Corrections | None = None
    summary: str | None = None
    seconds: float = 0.0


def start_from_points(config: Config, dataset: Dataset, device: Device, own_field: nn.Module | None = None) -> Start:
    """Start from initial points, and without motion in the first `schedule.warm_up` steps.

    config: resolved for the dataset. Raises InputError where its field is `own`, and there is no module.
    """
    scene = Scene4D.from_points(
        *initial_points(config.points, dataset, config.seed),
        config.field,
        opacity=INITIAL_OPACITY,
        antialiased=config.antialiased,
        device=device,
        seed=config.seed,
        own_field=own_field,
    )
    return Start(scene, warm_up_steps=config.schedule.warm_up)


def initial_points(
    config: PointsConfig, dataset: Dataset, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The first Gaussians, along a Morton curve: points (N, 3), colors (N, 3) and scales (N,).

    Without a cloud, the cameras tell where what stands still is (data/plane_sweep). All points lie there if most pixels
    show it, else as large a share as of the pixels. The others lie as data/initial_gaussians says.
    """
    points, colors = first_points(dataset, config.count, config.box, seed)
    if dataset.cloud is None and (surface := still_surface(dataset)) is not None:
        share = 1.0 if surface.share > MOST_PIXELS else surface.share
        known = min(round(share * len(points)), len(surface.points))
        chosen = np.random.default_rng(seed).choice(len(surface.points), known, replace=False)
        points[:known], colors[:known] = surface.points[chosen], surface.colors[chosen]
    scales = initial_scales(points)
    # Published figures of D-NeRF start from a fog, which the empty background there soon lifts.
    if dataset.cloud is not None or dataset.depths is not None:
        scales = limit_optical_depth(points, scales, INITIAL_OPACITY, dataset.cameras)
    order = morton_order(torch.from_numpy(points)).numpy()
    return points[order], colors[order], scales[order]


def max_field_rates(groups: Iterable[str], share: float = 1.0) -> dict[str, float]:
    """A share of the highest rate of each group of a field's parameters at which it keeps what discovery fitted."""
    return {name: share * (MAX_HASH_RATE if name == "hash" else MAX_MLP_RATE) for name in groups}
