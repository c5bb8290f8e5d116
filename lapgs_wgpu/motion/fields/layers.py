"""Linear layers: initialization from a generator, and products in the precision of the inputs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


def linear(shape: tuple[int, ...], generator: torch.Generator) -> nn.Linear:
    """A linear layer with a weight of this shape (outputs, inputs) and torch's own initial distribution."""
    outputs, inputs = shape
    layer = nn.Linear(inputs, outputs)
    reach = inputs**-0.5
    with torch.no_grad():
        layer.weight.uniform_(-reach, reach, generator=generator)
        layer.bias.uniform_(-reach, reach, generator=generator)
    return layer


def zero_head(shape: tuple[int, ...]) -> nn.Linear:
    """A linear layer with a weight of this shape (outputs, inputs), initialized to zero: it starts without effect."""
    outputs, inputs = shape
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def product(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """x (N, inputs) @ weight.T + bias in the precision of x, to which the float32 weights are rounded."""
    return nn.functional.linear(x, weight.to(x.dtype), bias.to(x.dtype))


def last_product(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The same product in float32 for any precision of x; gradients have the precision of x.

    For the heads: rounding errors of single features average out in the sum, but rounding the sum would move Gaussians.
    """
    return nn.functional.linear(x, weight, bias) if x.dtype == weight.dtype else _LastProduct.apply(x, weight, bias)


class _LastProduct(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return nn.functional.linear(x.to(weight.dtype), weight, bias)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        (d_output,) = d_outputs
        rounded = d_output.to(x.dtype)
        return rounded @ weight.to(x.dtype), (rounded.T @ x).to(weight.dtype), d_output.sum(0)
