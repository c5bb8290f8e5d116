"""The gate of the grid fields in torch: the reference of shaders/common/gate."""

from __future__ import annotations

import torch
from torch import Tensor


def gated(temporal: Tensor, half: Tensor) -> Tensor:
    """Temporal features, rectified, times 2 sigmoid(x) - 1 of the spatial layer's x (Grid4D; paper eq. 9).

    half: 0.5 x, since 2 sigmoid(x) - 1 = tanh(x / 2); its layer has half the weights, which is exact.
    """
    return torch.relu(temporal) * torch.tanh(half)
