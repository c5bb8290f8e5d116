"""The dynamics attributes d of the Gaussians: their outliers, and the loss L_dy (paper eqs. 10 to 12).

d: (N, D) float32, without a unit. The distance of a Gaussian is that between its row and the mean row.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_wgpu.motion.fields.config import DynamicsMode

# Tolerance: distances that are equal except for rounding are no outliers.
ROUNDING = 1e-6
# Bounds the gradient of `promote` while all rows are nearly equal, so that Adam's squares of it stay finite.
LEAST_DEVIATION = 1e-8


def outliers(d: Tensor) -> Tensor:
    """Return a mask (N,) of the rows whose distance exceeds the mean distance by a standard deviation (eqs. 10, 11).

    The standard deviation of the N distances is divided by N, not by N - 1. If all rows are equal, none is an outlier.
    """
    mask, _ = _outliers(_offsets(d.detach()))
    return mask


def dynamics_loss(d: Tensor, mode: DynamicsMode) -> Tensor:
    """L_dy (eq. 12), a scalar: the mean over all N rows of a term that is zero except for outliers.

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
    """Return each row less the mean row, (N, D)."""
    return d - d.detach().mean(dim=0)


def _outliers(offsets: Tensor) -> tuple[Tensor, Tensor]:
    """The outliers (N,), and the deviation of the distances, a scalar of the offsets' dtype."""
    distances = offsets.norm(dim=1).double()
    mean = distances.mean()
    deviation = (distances - mean).square().mean().sqrt()
    return distances > (1 + ROUNDING) * mean + deviation, deviation.to(offsets.dtype)
