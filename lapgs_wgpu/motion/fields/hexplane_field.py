"""The field hexplane, a baseline (4D-GS, Wu et al. 2024): features from six planes of space and time."""

import math

import torch
from torch import Tensor, nn

from lapgs_wgpu.motion.fields.config import TIME, FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby, linear
from lapgs_wgpu.motion.fields.parameter_shapes import HEXPLANE_HEADS, PLANES, parameter_shapes

# Weights of the smoothness loss that 4D-GS trains with on D-NeRF scenes.
SPACE_SMOOTHNESS, TIME_SMOOTHNESS, TIME_SPARSITY = 1e-4, 1e-2, 1e-4


class HexPlaneField(Field):
    """Features are products over the six planes, concatenated over the resolutions, and decoded by small MLPs.

    Outside the box, features are those of its border.
    """

    def __init__(self, config: FieldConfig, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.bound, self.unit, shapes = config.bound, config.unit, parameter_shapes(config)
        self.planes = nn.ParameterList()
        for number in range(len(PLANES) * config.planes.levels):
            # Time planes start at one, and thus without motion.
            plane = torch.ones(shapes[f"planes.{number}"])
            if PLANES[number % len(PLANES)][1] != TIME:
                plane.uniform_(0.1, 0.5, generator=generator)
            self.planes.append(nn.Parameter(plane))

        def layer(name: str, generator: torch.Generator | None = generator) -> list[nn.Module]:
            return [nn.ReLU(), linear(shapes[f"{name}.weight"], generator)]

        trunk = [each for i in range(config.depth + 1) for each in layer(f"trunk.{2 * i}")]
        self.trunk = nn.Sequential(*trunk[1:])  # not rectified before
        heads = [f"heads.{i}" for i in range(len(HEXPLANE_HEADS))]
        self.heads = nn.ModuleList(nn.Sequential(*layer(f"{h}.1"), *layer(f"{h}.3", None)) for h in heads)

    def forward(
        self, means: Tensor, t: float, dynamics: Tensor | None = None, nearby: Nearby | None = None
    ) -> Deformation:
        """See motion/fields/deformation.py."""
        unit = torch.cat([means.detach() / self.bound, means.new_full((len(means), 1), 2.0 * t - 1.0)], dim=1)
        levels = [self._features(unit, first) for first in range(0, len(self.planes), len(PLANES))]
        hidden = self.trunk(torch.cat(levels, dim=1))
        shift, d_quats, d_scales = (head(hidden) for head in self.heads)
        smoothness = self._smoothness() if nearby is not None else None
        return Deformation(None, self.unit * shift, d_quats, self.unit * d_scales, smoothness=smoothness)

    def _features(self, unit: Tensor, first: int) -> Tensor:
        """Return features (N, F) at points and times (N, 4) in [-1, 1], of the six planes from number `first` on."""
        features = []
        for plane, pair in zip(list(self.planes)[first : first + len(PLANES)], PLANES, strict=True):
            at = unit[None, None, :, list(pair)]
            features.append(nn.functional.grid_sample(plane, at, align_corners=True, padding_mode="border")[0, :, 0].T)
        return math.prod(features[1:], start=features[0])

    def _smoothness(self) -> Tensor:
        """4D-GS's: squared second differences along the second axis of each plane; time planes close to one."""
        total = self.planes[0].new_zeros(())
        for number, plane in enumerate(self.planes):
            bend = plane[:, :, 2:] - 2 * plane[:, :, 1:-1] + plane[:, :, :-2]
            if PLANES[number % len(PLANES)][1] == TIME:
                total = total + TIME_SMOOTHNESS * bend.square().mean() + TIME_SPARSITY * (1 - plane).abs().mean()
            else:
                total = total + SPACE_SMOOTHNESS * bend.square().mean()
        return total
