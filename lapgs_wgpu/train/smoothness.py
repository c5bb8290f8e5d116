"""Where the smoothness loss compares the field with itself."""

from __future__ import annotations

import torch

from lapgs_wgpu.motion.fields.deformation import Nearby
from lapgs_wgpu.train.config import SmoothnessConfig


def draw_nearby(config: SmoothnessConfig, count: int, t: float, generator: torch.Generator) -> Nearby | None:
    """Where the field of `count` Gaussians is compared with itself in a step at time t; None where it is not."""
    chosen = round(config.share * count)
    if chosen == 0 or config.static == config.temporal == 0:
        return None
    rows = torch.randint(count, (chosen,), generator=generator)
    offsets = config.reach * (2 * torch.rand(chosen, 3, generator=generator) - 1)
    return Nearby(rows, offsets, near_time(config, t, generator), config.static, config.temporal)


def near_time(config: SmoothnessConfig, t: float, generator: torch.Generator) -> float:
    """Draw the other time at which the field is looked at."""
    return min(max(t + config.time_reach * (2 * float(torch.rand((), generator=generator)) - 1), 0.0), 1.0)
