"""The field mlp, a baseline (deformable 3DGS, Yang et al. 2024): one MLP of position and time, without grids."""

import math

import torch
from torch import Tensor, nn

from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby, linear
from lapgs_wgpu.motion.fields.parameter_shapes import (
    MLP_LAYERS,
    MLP_OUTPUTS,
    MLP_SKIP,
    PLACE_OCTAVES,
    TIME_OCTAVES,
    parameter_shapes,
)


class MlpField(Field):
    """Eight layers over sines of position and time, whose outputs are added to mean, quaternion and scale."""

    def __init__(self, config: FieldConfig, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        shapes = parameter_shapes(config)
        self.bound, self.unit = config.bound, config.unit
        self.time = nn.Sequential(
            linear(shapes["time.0.weight"], generator), nn.ReLU(), linear(shapes["time.2.weight"], generator)
        )
        self.layers = nn.ModuleList(linear(shapes[f"layers.{i}.weight"], generator) for i in range(MLP_LAYERS))
        self.heads = linear(shapes["heads.weight"])

    def forward(
        self, means: Tensor, t: float, dynamics: Tensor | None = None, nearby: Nearby | None = None
    ) -> Deformation:
        """See motion/fields/deformation.py; this field has no smoothness loss."""
        time = self.time(octaves(means.new_tensor([[t]]), TIME_OCTAVES)).expand(len(means), -1)
        inputs = torch.cat([octaves(means.detach() / self.bound, PLACE_OCTAVES), time], dim=1)
        hidden = inputs
        for number, layer in enumerate(self.layers):
            hidden = torch.relu(layer(torch.cat([inputs, hidden], dim=1) if number == MLP_SKIP else hidden))
        shift, d_quats, d_scales = self.heads(hidden).split(MLP_OUTPUTS, dim=1)
        return Deformation(None, self.unit * shift, d_quats, self.unit * d_scales)


def octaves(values: Tensor, count: int) -> Tensor:
    """Return values (N, D) with their sines and cosines at pi, 2 pi, 4 pi, ... per unit: (N, D (1 + 2 count))."""
    angles = [values * (math.pi * 2.0**k) for k in range(count)]
    return torch.cat([values, *(f(angle) for angle in angles for f in (torch.sin, torch.cos))], dim=1)
