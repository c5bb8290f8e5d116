"""The deformation field: how each Gaussian is moved, turned and scaled at a time.

`grid4d` is Grid4D's decoder (Xu et al. 2024): temporal hash features, gated by spatial ones, then linear heads.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from ..gpu.device import Device
from .hashgrid import TIME, HashConfig, HashEncoder, HashGrid, option

FieldKind = Literal["static", "grid4d"]


@dataclass(frozen=True)
class FieldConfig:
    """The shape of a field."""

    kind: FieldKind = option("grid4d", "static (nothing moves) or grid4d")
    bound: float = option(
        1.6, "half side of the box that the encoder covers, world units; outside it features are zero"
    )
    static: HashConfig = field(default_factory=lambda: HashConfig(16, (16, 16, 16), (2048, 2048, 2048)))
    temporal: HashConfig = field(default_factory=lambda: HashConfig(32, (8, 8, 8), (32, 32, 16)))
    width: int = option(256, "of the decoder")
    depth: int = option(0, "hidden layers between the fused features and the heads")
    time_scale: float = option(0.9, "share of the temporal grids' time axis that the clip fills")


class Deformation(NamedTuple):
    """What is done to N Gaussians at a time: means are turned by `rotation` (N, 4) wxyz of unit length about the origin
    and shifted by `translation` (N, 3); d_quats (N, 4) and d_scales (N, 3) are added to unit quaternions and scales."""

    rotation: Tensor
    translation: Tensor
    d_quats: Tensor
    d_scales: Tensor


class Grid4DField(nn.Module):
    """Grid4D's field. With all heads at zero, as at the start, nothing moves."""

    def __init__(self, config: FieldConfig, device: Device, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.config = config
        axes = ((0, 1, TIME), (1, 2, TIME), (0, 2, TIME))
        self.static_grid = HashGrid(config.static, (0, 1, 2), generator)
        self.temporal_grids = nn.ModuleList(HashGrid(config.temporal, three, generator) for three in axes)
        self._encoder = HashEncoder(device, self.grids, config.bound)
        width = config.width
        self.spatial = _linear(self.static_grid.features, width, generator)
        self.temporal = _linear(sum(grid.features for grid in self.grids[1:]), width, generator)
        hidden = [layer for _ in range(config.depth) for layer in (_linear(width, width, generator), nn.ReLU())]
        self.hidden = nn.Sequential(*hidden)
        # One layer for all geometry heads: turn (4), shift (3), quaternion (4), scale (3).
        self.heads = nn.Linear(width, 14)
        nn.init.zeros_(self.heads.weight)
        nn.init.zeros_(self.heads.bias)

    @property
    def grids(self) -> list[HashGrid]:
        """All four, the static one first."""
        return [self.static_grid, *(grid for grid in self.temporal_grids if isinstance(grid, HashGrid))]

    def grid_time(self, t: float) -> float:
        """A time in [0, 1] as the place on the temporal grids' time axis."""
        return 0.5 * ((2.0 * t - 1.0) * self.config.time_scale + 1.0)

    def forward(self, means: Tensor, t: float) -> Deformation:
        """means: (N, 3) canonical, world units; no gradient reaches them from here. t in [0, 1]."""
        static, *temporal = self._encoder(means, self.grid_time(t))
        gate = 2.0 * torch.sigmoid(self.spatial(static)) - 1.0
        hidden = self.hidden(torch.relu(self.temporal(torch.cat(temporal, dim=1))) * gate)
        turn, shift, d_quats, d_scales = self.heads(hidden).split((4, 3, 4, 3), dim=1)
        rotation = nn.functional.normalize(turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=1)
        return Deformation(rotation, shift, d_quats, d_scales)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by learning-rate group: "hash" tables and "mlp" weights."""
        tables = [grid.table for grid in self.grids]
        known = {id(table) for table in tables}
        return {"hash": tables, "mlp": [p for p in self.parameters() if id(p) not in known]}


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with torch's own initial distribution, drawn from our generator."""
    layer = nn.Linear(inputs, outputs)
    reach = inputs**-0.5
    with torch.no_grad():
        layer.weight.uniform_(-reach, reach, generator=generator)
        layer.bias.uniform_(-reach, reach, generator=generator)
    return layer


def make_field(config: FieldConfig, device: Device, seed: int = 0) -> Grid4DField | None:
    """The field of this configuration, None for static scenes."""
    return None if config.kind == "static" else Grid4DField(config, device, seed)
