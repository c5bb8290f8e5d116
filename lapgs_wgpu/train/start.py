"""What a training starts with: initial points, or what motion discovery found (lapgs_wgpu/discovery)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from torch import nn

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.initial_points import initial_points

# Learning rates at which a field keeps what discovery fitted; at higher ones Adam's noise undoes the fit.
MAX_HASH_RATE, MAX_MLP_RATE = 5e-3, 1e-3


@dataclass(frozen=True)
class Start:
    """What a training starts with.

    Attributes:
        scene: the first Gaussians, and the field.
        warm_up_steps: number of the first steps without motion.
        ramp_steps: number of the first steps over which the learning rates rise from 0.
        field_fitted: whether the field knows nearly all that moves: its rates then stay low (`max_field_rates`), and
            the acceleration loss is left out.
        corrections: of the training cameras; None where they are as given.
        summary: what discovery found, a sentence; None without discovery.
        seconds: that discovery took.
    """

    scene: Scene4D
    warm_up_steps: int = 0
    ramp_steps: int = 0
    field_fitted: bool = False
    corrections: Corrections | None = None
    summary: str | None = None
    seconds: float = 0.0


def start_from_points(config: Config, dataset: Dataset, device: Device, own_field: nn.Module | None = None) -> Start:
    """Start from initial points, and without motion in the first `schedule.warm_up` steps.

    Args:
        config: resolved for the dataset.
        dataset: the capture.
        device: that trains.
        own_field: of Scene4D.

    Raises:
        InputError: the configuration's field is `own`, and there is no module.
    """
    scene = Scene4D.from_points(
        *initial_points(config.points, dataset, config.seed),
        config.field,
        opacity=config.points.opacity,
        antialiased=config.antialiased,
        device=device,
        seed=config.seed,
        own_field=own_field,
    )
    return Start(scene, warm_up_steps=config.schedule.warm_up)


def max_field_rates(groups: Iterable[str]) -> dict[str, float]:
    """The highest learning rate of each group of a field's parameters at which it keeps what discovery fitted."""
    return {name: MAX_HASH_RATE if name == "hash" else MAX_MLP_RATE for name in groups}
