"""The acceleration loss: how far Gaussians are from where and how large they would be if they moved evenly.

A moment that one camera sees says nothing of how far away things are; its neighbours in time, seen from elsewhere, do.
Distances saturate, so that what really turns quickly is not held back.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.config import AccelerationConfig

WOBBLE = 1e-2  # world units: distances far below it count as they are, those far above it all as much as it
EPSILON = 1e-12  # world units squared: keeps the gradient of a distance of 0 finite


class Moments(NamedTuple):
    """What a step compares. rows: (M,) Gaussians. before, after: times in [0, 1] around that of the step's view."""

    rows: Tensor
    before: float
    after: float


def draw_moments(
    config: AccelerationConfig, count: int, t: float, times: int, generator: torch.Generator
) -> Moments | None:
    """Where the acceleration loss of `count` Gaussians looks in a step at time t; None where it is off. At an end of
    the clip one of the times is t itself, and the loss 0. times: how many moments the training images show."""
    chosen = round(config.share * count)
    if chosen == 0 or config.weight == 0 or times < 2:
        return None
    rows = torch.randint(count, (chosen,), generator=generator)
    reach = config.frames / (times - 1) * (1 + float(torch.rand((), generator=generator))) / 2
    return Moments(rows, max(t - reach, 0.0), min(t + reach, 1.0))


def acceleration_loss(scene: Scene4D, now: Gaussians, t: float, moments: Moments) -> Tensor:
    """The robust distance of means from the straight line between those before and after, and likewise of scales, on
    the average over the chosen Gaussians; world units. now: the scene's Gaussians at time t."""
    rows = moments.rows
    before, after = (scene.deformed(each, rows=rows)[0] for each in (moments.before, moments.after))
    share = (t - moments.before) / (moments.after - moments.before)
    means = now.means[rows] - torch.lerp(before.means, after.means, share)
    scales = now.scales[rows] - torch.lerp(before.scales, after.scales, share)
    return robust_length(means) + robust_length(scales)


def robust_length(vectors: Tensor) -> Tensor:
    """The mean over vectors (M, 3) of c l / (l + c), l the length and c = WOBBLE."""
    lengths = (vectors.square().sum(dim=1) + EPSILON).sqrt()
    return (WOBBLE * lengths / (lengths + WOBBLE)).mean()
