"""The fields grid4d and laplacian (the paper's, an extension of grid4d), over four hash grids."""

import torch
from torch import Tensor, nn

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig, temporal_grids
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby, TimeSamples, linear
from lapgs_wgpu.motion.fields.hash_encoder import HashEncoder, HashGrid
from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion, TimeMotion
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.fields.torch_decoder import DecoderWeights, decode


class GridField(Field):
    """grid4d: temporal hash features, gated by spatial ones, then linear heads (Grid4D, Xu et al. 2024; paper eq. 9).

    laplacian: concatenates each Gaussian's dynamics attribute with its temporal features (eq. 8), adds the Laplacian
    motion before the heads (eq. 6), and has an appearance head for changes of brightness. With all of these at zero it
    equals grid4d.

    Torch computes the decoder; a training step that stays on the device has motion/passes/grid_field_passes instead.
    """

    def __init__(self, config: FieldConfig, device: Device, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.config, shapes = config, parameter_shapes(config)

        def layer(name: str) -> nn.Linear:
            return linear(shapes[f"{name}.weight"], generator)

        self.static_grid = HashGrid(config.static, (0, 1, 2), generator)
        temporal = [HashGrid(config.temporal, grid.axes, generator) for grid in temporal_grids(config)]
        self.temporal_grids = nn.ModuleList(temporal)
        self.grids = [self.static_grid, *temporal]
        self._encoder = HashEncoder(device, [[self.static_grid], temporal], config.bound)
        self.spatial = layer("spatial")
        self.temporal = layer("temporal")
        hidden = [(layer(f"hidden.{2 * i}"), nn.ReLU()) for i in range(config.depth)]
        self.hidden = nn.Sequential(*(each for pair in hidden for each in pair))
        self.heads = linear(shapes["heads.weight"])
        self.motion: LaplacianMotion | TimeMotion | None = None
        if config.kind == "laplacian":
            kind = LaplacianMotion if config.motion == "laplacian" else TimeMotion
            self.motion = kind(self.static_grid.features, config, generator)
        self.appearance = linear(shapes["appearance.weight"]) if config.appearance_size else None

    def forward(
        self, means: Tensor, t: float, dynamics: Tensor | None = None, nearby: Nearby | None = None
    ) -> Deformation:
        """See motion/fields/deformation.py."""
        return self.at_times(means, t, dynamics, nearby, None)[0]

    def at_times(
        self, means: Tensor, t: float, dynamics: Tensor | None, nearby: Nearby | None, time_samples: TimeSamples | None
    ) -> list[Deformation]:
        """See motion/fields/deformation.py. All are encoded together, which takes much less time than apart."""
        places, decoded = [(means, self.config.grid_time(t))], [(t, dynamics)]
        if nearby is not None:
            places.append((means[nearby.rows] + nearby.offsets, self.config.grid_time(nearby.time)))
        if time_samples is not None:
            their_means, their_dynamics = time_samples.chosen(means, dynamics)
            places += [(their_means, self.config.grid_time(time)) for time in time_samples.times]
            decoded += [(time, their_dynamics) for time in time_samples.times]
        here, *others = self._encoder.encode_all(places)
        smoothness = None
        if nearby is not None:
            near, *others = others
            smoothness = _smoothness(here, near, nearby)
        outputs = [self._decode(*given, *each) for given, each in zip(decoded, [here, *others], strict=True)]
        now, *later = map(self._deformation, outputs)
        return [now._replace(smoothness=smoothness), *later]

    def _deformation(self, outputs: Tensor) -> Deformation:
        size = self.config.appearance_size
        turn, shift, d_quats, d_scales, look = outputs.split((*GEOMETRY, size), dim=1)
        rotation = nn.functional.normalize(turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=1)
        d_dc, d_opacity = look[:, :3] if size else None, look[:, 3] if size == 4 else None
        return Deformation(rotation, shift, d_quats, d_scales, d_dc, d_opacity)

    def _decode(self, t: float, dynamics: Tensor | None, static: Tensor, temporal: Tensor) -> Tensor:
        """Return the outputs of the geometry heads (N, 14) and, in further columns, of the appearance head."""
        size = self.config.dynamics_size
        dynamics = dynamics if size and dynamics is not None else static.new_zeros(len(static), size)
        outputs = decode(static, temporal, dynamics, self._weights(t))
        if not len(self.hidden):
            return outputs
        fused, *gated = outputs.split(self.config.width, dim=1)
        look = [] if self.appearance is None else [self.appearance(*gated)]
        return torch.cat([self.heads(self.hidden(fused)), *look], dim=1) * self._head_factors()

    def _weights(self, t: float) -> DecoderWeights:
        """Return the decoder's weights at a time.

        The second layer of the motion, which only linear layers follow, is folded into the heads, and all heads are one
        matrix, so that the features' gradient (N, width) is written once. Before hidden layers the heads are the
        identity, once more for the gated channels, which the appearance head reads.
        """
        size = self.config.dynamics_size
        if len(self.hidden):
            moved = self.config.width
            heads = torch.eye(moved).repeat(1 if self.appearance is None else 2, 1)
            bias = heads.new_zeros(len(heads))
        else:
            layers = [self.heads] if self.appearance is None else [self.heads, self.appearance]
            factors = self._head_factors()
            heads = torch.cat([head.weight for head in layers]) * factors[:, None]
            bias = torch.cat([head.bias for head in layers]) * factors
            moved = sum(GEOMETRY)  # heads that the motion reaches
        inner, inner_bias = heads.new_zeros(0, self.static_grid.features), heads.new_zeros(0)
        motion_heads = heads.new_zeros(len(heads), 0)
        if self.motion is not None:
            (inner, inner_bias), second = self.motion.layers(t)
            folded, shift = (heads[:moved] @ factor for factor in second)
            rest = len(heads) - moved
            motion_heads = nn.functional.pad(folded, (0, 0, 0, rest))
            bias = bias + nn.functional.pad(shift, (0, rest))
        return DecoderWeights(
            spatial=0.5 * self.spatial.weight,
            spatial_bias=0.5 * self.spatial.bias,
            temporal=self.temporal.weight[:, size:] if self.config.temporal_hash else self.temporal.weight[:, :0],
            dynamics=self.temporal.weight[:, :size],
            temporal_bias=self.temporal.bias,
            inner=inner,
            inner_bias=inner_bias,
            heads=heads,
            motion_heads=motion_heads,
            heads_bias=bias,
        )

    def _head_factors(self) -> Tensor:
        return self.heads.bias.new_tensor(self.config.head_factors)


def _smoothness(here: list[Tensor], near: list[Tensor], nearby: Nearby) -> Tensor:
    """Grid4D's smoothness loss: the mean squared distance between the features of near places, static and temporal."""
    sq_distances = torch.stack([(b - a[nearby.rows]).square().sum() for a, b in zip(here, near, strict=True)])
    weights = sq_distances.new_tensor([nearby.static_weight, nearby.temporal_weight])
    return (weights * sq_distances).sum() / max(1, len(nearby.rows))
