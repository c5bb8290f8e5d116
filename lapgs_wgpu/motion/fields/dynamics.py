"""The dynamics attribute d of the Gaussians (the paper's section on it, equations 10 to 12): who stands out, and L_dy.

d: (N, 16) float32, without a unit. The distance of a Gaussian is that of its row from the mean row.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .config import DynamicsMode

# Distances that are equal but for float32's rounding must not stand out. Where they differ it changes nothing.
ROUNDING = 1e-6
# Bounds the gradient of `promote` while the rows still are (nearly) equal, so that Adam's squares of it stay finite.
LEAST_DEVIATION = 1e-8


def outliers(d: Tensor) -> Tensor:
    """(N,) bool: whose distance from the mean row exceeds the mean distance by a standard deviation (equations 10, 11).

    The deviation is that of all N distances (divided by N, not by N - 1). No row stands out where all are equal, nor
    where there is but one.
    """
    mask, _ = _outliers(_offsets(d.detach()))
    return mask


def dynamics_loss(d: Tensor, mode: DynamicsMode) -> Tensor:
    """L_dy (equation 12), a scalar: the mean over all N rows of a term that is zero but for the outliers.

    literal: the squared distance, as in the paper's equation; its descent pulls outliers to the mean.
    promote: -log(1 + squared distance / squared deviation of the distances), as in the paper's text; its descent pushes
    outliers away, ever more weakly. off: zero.
    The mean row, the mask and the deviation are constants to the gradient.
    """
    if mode == "off":
        return d.new_zeros(())
    offsets = _offsets(d)
    mask, deviation = _outliers(offsets.detach())
    if mode == "literal":
        terms = offsets.square().sum(dim=1)
    elif mode == "promote":
        terms = -torch.log1p((offsets / deviation.clamp(min=LEAST_DEVIATION)).square().sum(dim=1))
    else:
        raise ValueError(f"mode must be literal, promote or off, got {mode!r}")
    return (mask * terms).sum() / max(len(d), 1)


def _offsets(d: Tensor) -> Tensor:
    """(N, 16) each row less the mean row."""
    return d - d.detach().mean(dim=0)


def _outliers(offsets: Tensor) -> tuple[Tensor, Tensor]:
    """The outliers (N,), and the deviation of the distances, a scalar of the offsets' dtype."""
    distances = offsets.norm(dim=1).double()
    mean = distances.mean()
    deviation = (distances - mean).square().mean().sqrt()
    return distances > (1 + ROUNDING) * mean + deviation, deviation.to(offsets.dtype)
