"""The paper's Laplacian motion module (eqs. 2-6): one spectrum of learnable frequencies moves all Gaussians."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from .layers import last_product, linear, product
from .parameter_shapes import laplacian_motion, time_motion

VARIANCE_FLOOR = 1e-4
VARIANCE_SPREAD = (
    10.0  # a component's variance counts as at most this times the geometric mean of all, and at least 1/this
)


class Factors(NamedTuple):
    """Features (N, W) = inner (N, W) @ matrix.T (W, W) + bias (W,), not multiplied out, so that where only linear heads
    follow they can be folded into the matrix, which is small."""

    inner: Tensor
    matrix: Tensor
    bias: Tensor

    def features(self) -> Tensor:
        """(N, W)."""
        return product(self.inner, self.matrix, self.bias)

    def through(self, weight: Tensor) -> Tensor:
        """features() @ weight.T for a weight of (outputs, W), in fewer operations."""
        return last_product(self.inner, weight @ self.matrix, weight @ self.bias)


class LaplacianMotion(nn.Module):
    """A_L(t) = L(t) * M(H_s), with L(t) = sum over k of alpha_k cos(2 pi f_k t) + beta_k sin(2 pi f_k t).

    alpha, beta: (K, W), shared by all Gaussians; frequencies: (K,), cycles over the clip, at first 0, 1, ... K - 1
    times frequency_step. At first the standard deviation of a channel of L(t) is `amplitude`.
    M: two layers from the static features H_s, by which each Gaussian picks its part of the motion.
    """

    def __init__(
        self,
        inputs: int,
        width: int,
        components: int,
        generator: torch.Generator,
        *,
        frequency_step: float = 1.0,
        amplitude: float = 0.3,
    ) -> None:
        super().__init__()
        # Faint, and fainter at higher frequencies, as smooth motions are: so that the heads do not learn to explain
        # single pictures by a flicker. Not zero: with both factors at zero the product would have no gradient.
        shapes = laplacian_motion(inputs, width, components)
        fall = 1.0 / torch.arange(components).clamp(min=1)[:, None]
        size = amplitude * fall / fall.square().sum().sqrt()
        self.alpha = nn.Parameter(torch.randn(shapes["alpha"], generator=generator) * size)
        self.beta = nn.Parameter(torch.randn(shapes["beta"], generator=generator) * size)
        self.frequencies = nn.Parameter(frequency_step * torch.arange(components, dtype=torch.float32))
        self.first = linear(shapes["first.weight"], generator)
        self.second = linear(shapes["second.weight"], generator)

    def series(self, t: float) -> Tensor:
        """L(t), (W,), at a time in [0, 1]."""
        phase = (2 * math.pi * t) * self.frequencies
        return phase.cos() @ self.alpha + phase.sin() @ self.beta

    def forward(self, static: Tensor, t: float) -> Factors:
        """A_L of Gaussians with the static features H_s (N, inputs)."""
        inner = torch.relu(product(static, self.first.weight, self.first.bias))
        return Factors(inner, *self.second_factor(t))

    def second_factor(self, t: float) -> tuple[Tensor, Tensor]:
        """Matrix (W, W) and bias (W,) of `Factors`."""
        series = self.series(t)
        return series[:, None] * self.second.weight, series * self.second.bias

    def amplitudes(self) -> Tensor:
        """(K,) |c_k|, the root of the mean over the channels of alpha^2 + beta^2; without gradient."""
        with torch.no_grad():
            return (self.alpha.square() + self.beta.square()).mean(dim=1).sqrt()

    def variances(self) -> Tensor:
        """(K,) sigma_k^2 of eq. 5: the variance over time of each component, floored and kept within a factor of the
        geometric mean, so that a faint component does not run away; without gradient."""
        variance = 0.5 * self.amplitudes().square() + VARIANCE_FLOOR
        middle = variance.log().mean().exp()
        return variance.clamp(middle / VARIANCE_SPREAD, middle * VARIANCE_SPREAD)

    def frequency_gradient(self) -> Tensor:
        """(K,) eq. 5's gradient: the loss's derivative by f_k over 2 pi sigma_k^2 (the equation leaves out the factor
        2 pi of the derivative of cos(2 pi f t)). Needs a backward pass before."""
        gradient = self.frequencies.grad
        if gradient is None:
            raise ValueError("frequency_gradient needs the gradient of the frequencies: call backward() first")
        return gradient / (2 * math.pi * self.variances())


class TimeMotion(nn.Module):
    """What stands in for LaplacianMotion in the ablation without it: a decoder of (H_s, t) of equal size."""

    def __init__(self, inputs: int, width: int, generator: torch.Generator) -> None:
        super().__init__()
        shapes = time_motion(inputs, width)
        self.first = linear(shapes["first.weight"], generator)
        self.second = linear(shapes["second.weight"], generator)

    def forward(self, static: Tensor, t: float) -> Factors:
        """The features of Gaussians with the static features H_s (N, inputs)."""
        time = static.new_full((len(static), 1), t)
        inner = torch.relu(product(torch.cat([static, time], dim=1), self.first.weight, self.first.bias))
        return Factors(inner, self.second.weight, self.second.bias)
