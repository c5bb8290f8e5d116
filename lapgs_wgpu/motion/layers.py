"""Linear layers whose initial weights come from a given generator."""

from __future__ import annotations

import torch
from torch import nn


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with torch's own initial distribution."""
    layer = nn.Linear(inputs, outputs)
    reach = inputs**-0.5
    with torch.no_grad():
        layer.weight.uniform_(-reach, reach, generator=generator)
        layer.bias.uniform_(-reach, reach, generator=generator)
    return layer


def zero_head(inputs: int, outputs: int) -> nn.Linear:
    """A linear layer of zeros, so that what it changes starts unchanged."""
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
