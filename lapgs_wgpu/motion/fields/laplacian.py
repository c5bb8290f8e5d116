"""The Laplacian motion module (paper eqs. 2 to 6): one spectrum of learnable frequencies moves all Gaussians."""

import math

import torch
from torch import Tensor, nn

from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import linear

VARIANCE_FLOOR = 1e-4
# A component's variance counts as at most this times the geometric mean of all, and at least 1 / this.
VARIANCE_SPREAD = 10.0

Layer = tuple[Tensor, Tensor]  # weight (outputs, inputs) and bias (outputs,)


class LaplacianMotion(nn.Module):
    """A_L(t) = L(t) * M(H_s), with L(t) = sum over k of alpha_k cos(2 pi f_k t) + beta_k sin(2 pi f_k t).

    alpha, beta: (K, W), shared by all Gaussians. frequencies: (K,) cycles over the clip, initially 0, 1, ... K - 1
    times frequency_step. amplitude: initial standard deviation of a channel of L(t).
    M: two layers on the static features H_s, which select each Gaussian's part of the motion.
    """

    def __init__(self, inputs: int, config: FieldConfig, generator: torch.Generator) -> None:
        super().__init__()
        # Small, and smaller at higher frequencies, as in smooth motion: otherwise the heads would learn to explain
        # single images by flicker. Not zero: if both factors were zero, the product would have no gradient.
        shape = config.components, config.width
        fall = 1.0 / torch.arange(config.components).clamp(min=1)[:, None]
        size = config.amplitude * fall / fall.square().sum().sqrt()
        self.alpha = nn.Parameter(torch.randn(shape, generator=generator) * size)
        self.beta = nn.Parameter(torch.randn(shape, generator=generator) * size)
        self.frequencies = nn.Parameter(config.frequency_step * torch.arange(config.components, dtype=torch.float32))
        self.first = linear((config.width, inputs), generator)
        self.second = linear((config.width, config.width), generator)

    def series(self, t: float) -> Tensor:
        """L(t), (W,), at a time in [0, 1]."""
        phase = (2 * math.pi * t) * self.frequencies
        return phase.cos() @ self.alpha + phase.sin() @ self.beta

    def layers(self, t: float) -> tuple[Layer, Layer]:
        """Return the layers of A_L at a time: rectified channels of static features, and features (N, W) of these."""
        series = self.series(t)
        return (self.first.weight, self.first.bias), (series[:, None] * self.second.weight, series * self.second.bias)

    @torch.no_grad()
    def variances(self) -> Tensor:
        """Return sigma_k^2 of eq. 5, (K,): the variance of each component over time; without gradient.

        It is limited to a factor around the geometric mean, so that the frequencies of small components stay stable.
        """
        amplitudes = (self.alpha.square() + self.beta.square()).mean(dim=1).sqrt()
        variance = 0.5 * amplitudes.square() + VARIANCE_FLOOR
        middle = variance.log().mean().exp()
        return variance.clamp(middle / VARIANCE_SPREAD, middle * VARIANCE_SPREAD)

    def frequency_gradient(self) -> Tensor:
        """Return the gradient of eq. 5, (K,): the loss's derivative by f_k, divided by 2 pi sigma_k^2. (The equation
        omits the factor 2 pi of the derivative of cos(2 pi f t).) Requires a previous backward pass."""
        assert self.frequencies.grad is not None
        return self.frequencies.grad / (2 * math.pi * self.variances())


class TimeMotion(nn.Module):
    """The replacement of LaplacianMotion in its ablation: an MLP of (H_s, t) of equal size."""

    def __init__(self, inputs: int, config: FieldConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.first = linear((config.width, inputs + 1), generator)
        self.second = linear((config.width, config.width), generator)

    def layers(self, t: float) -> tuple[Layer, Layer]:
        """Return layers as LaplacianMotion.layers does; the time, the last input, is part of the bias."""
        weight, bias = self.first.weight, self.first.bias
        return (weight[:, :-1], bias + t * weight[:, -1]), (self.second.weight, self.second.bias)
