"""The gate of the grid fields in torch; shaders/common/gate.wgsl is the same for kernels."""

from __future__ import annotations

import torch
from torch import Tensor


def gated(temporal: Tensor, half: Tensor) -> Tensor:
    """relu(temporal features) times 2 sigmoid(x) - 1, where x is the spatial layer's output (Grid4D; paper eq. 9).

    half: 0.5 x, since 2 sigmoid(x) - 1 = tanh(x / 2); the layer's weights are halved, which is exact.
    """
    return torch.relu(temporal) * torch.tanh(half)


def opening(half: Tensor) -> Tensor:
    """tanh(half), which it overwrites, by torch's sigmoid, which takes a tenth of the time of its tanh; without
    gradient. In bfloat16 by tanh, since 2 sigmoid - 1 would lose most of its 8 bits."""
    return half.tanh_() if half.dtype == torch.bfloat16 else half.mul_(2).sigmoid_().mul_(2).sub_(1)
