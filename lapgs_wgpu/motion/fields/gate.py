"""The gate of the grid fields in torch; shaders/common/gate.wgsl is the same for kernels."""

from __future__ import annotations

import torch
from torch import Tensor


def gated(temporal: Tensor, half: Tensor) -> Tensor:
    """relu(temporal features) times 2 sigmoid(x) - 1, where x is the spatial layer's output (Grid4D; paper eq. 9).

    half: 0.5 x, since 2 sigmoid(x) - 1 = tanh(x / 2); the layer's weights are halved, which is exact.
    """
    return torch.relu(temporal) * torch.tanh(half)
