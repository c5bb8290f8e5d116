"""The losses of motion, smoothness and acceleration: what they compare in a step, and the latter itself.

Smoothness (of Grid4D; each field computes its own) compares the field's features at nearby places and times.
Acceleration is how far Gaussians are from where and how large they would be if they moved evenly. A time that one
camera sees says nothing of how far away things are; its neighbours in time, seen from elsewhere, do. Distances
saturate, so that what really turns quickly is not held back.
"""

import torch
from torch import Tensor

from lapgs_wgpu.motion.fields.deformation import Deformed, TimeSamples
from lapgs_wgpu.train.config import Config, SmoothnessConfig
from lapgs_wgpu.train.step_result import Scheduled

WOBBLE = 1e-2  # world units: distances far below it count as they are, those far above it all as much as it
EPSILON = 1e-12  # world units squared: keeps the gradient of a distance of 0 finite
# Largest distance of the two times from the view's, in distances of two images; drawn between half of it and all.
LARGEST_DISTANCE = 2.0


def compared_counts(
    config: Config, scheduled: Scheduled, count: int, time_count: int, *, fitted: bool
) -> tuple[int, int]:
    """How many of `count` Gaussians the smoothness and the acceleration loss look at in a step; 0: it is off.

    Of a clip of time_count = 2 times both are ends, at which the acceleration loss is 0. fitted: whether discovery has
    fitted the field to nearly all that moves; its depth is known from there, and the acceleration loss is left out.
    """
    smooth, even = config.smoothness, config.acceleration
    if not scheduled.moving or scheduled.step <= smooth.start:
        return 0, 0
    near_count = round(smooth.share * count) if smooth.static or smooth.temporal else 0
    left_out = fitted or scheduled.step % even.interval or not even.weight or time_count < 3
    return near_count, 0 if left_out else round(even.share * count)


def near_time(config: SmoothnessConfig, t: float, generator: torch.Generator) -> float:
    """Draw the time at which the field is compared with itself at time t."""
    return min(max(t + config.time_reach * (2 * float(torch.rand((), generator=generator)) - 1), 0.0), 1.0)


def even_times(t: float, time_count: int, generator: torch.Generator) -> tuple[float, float]:
    """Draw the times before and after t at which the acceleration loss looks; at an end of the clip one is t itself,
    and the loss is 0."""
    reach = LARGEST_DISTANCE / (time_count - 1) * (1 + float(torch.rand((), generator=generator))) / 2
    return max(t - reach, 0.0), min(t + reach, 1.0)


def acceleration_loss(now: Deformed, t: float, samples: TimeSamples) -> Tensor:
    """The robust distance of means from the straight line between those before and after, and likewise of scales.

    It is the average over the chosen Gaussians, in world units. now: the Gaussians at time t and at the sampled times.
    """
    rows, (before, after) = samples
    share = (t - before) / (after - before)
    (first_means, first_scales), (last_means, last_scales) = now.at_times
    means = now.gaussians.means[rows] - torch.lerp(first_means, last_means, share)
    scales = now.gaussians.scales[rows] - torch.lerp(first_scales, last_scales, share)
    return robust_length(means) + robust_length(scales)


def robust_length(vectors: Tensor) -> Tensor:
    """The mean over vectors (M, 3) of c l / (l + c), l the length and c = WOBBLE."""
    lengths = (vectors.square().sum(dim=1) + EPSILON).sqrt()
    return (WOBBLE * lengths / (lengths + WOBBLE)).mean()
