"""Linear layers, initialized from a generator or to zero."""

from __future__ import annotations

import torch
from torch import nn


def linear(shape: tuple[int, ...], generator: torch.Generator) -> nn.Linear:
    """Return a linear layer with a weight of this shape (outputs, inputs) and torch's own initial distribution."""
    layer = zero_head(shape)
    reach = shape[1] ** -0.5
    with torch.no_grad():
        layer.weight.uniform_(-reach, reach, generator=generator)
        layer.bias.uniform_(-reach, reach, generator=generator)
    return layer


def zero_head(shape: tuple[int, ...]) -> nn.Linear:
    """Return a linear layer with a weight of this shape (outputs, inputs), all zero: it starts without effect."""
    outputs, inputs = shape
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
