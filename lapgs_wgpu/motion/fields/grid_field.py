"""The fields grid4d and laplacian (the paper's, an extension of grid4d), over four hash grids."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import GEOMETRY, TEMPORAL_AXES, FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, Nearby, TimeSamples
from lapgs_wgpu.motion.fields.hash_encoder import HashEncoder, HashGrid
from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion, TimeMotion
from lapgs_wgpu.motion.fields.layers import linear, zero_head
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.fields.torch_decoder import KEPT, DecoderWeights, decode

_BLOCK = 1 << 13  # Gaussians per block decoded by hidden layers


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
        ours = config.kind == "laplacian"
        self.config = config
        self.static_grid = HashGrid(config.static, (0, 1, 2), generator)
        axes = TEMPORAL_AXES if config.temporal_hash else ()
        self.temporal_grids = nn.ModuleList(HashGrid(config.temporal, three, generator) for three in axes)
        groups = [[self.static_grid], self.grids[1:]] if axes else [[self.static_grid]]
        self._encoder = HashEncoder(device, groups, config.bound)
        static = self.static_grid.features
        shapes = parameter_shapes(config)
        self.spatial = linear(shapes["spatial.weight"], generator)
        self.temporal = linear(shapes["temporal.weight"], generator)
        hidden = [(linear(shapes[f"hidden.{2 * i}.weight"], generator), nn.ReLU()) for i in range(config.depth)]
        self.hidden = nn.Sequential(*(layer for pair in hidden for layer in pair))
        self.heads = zero_head(shapes["heads.weight"])
        self.motion: LaplacianMotion | TimeMotion | None = None
        if ours and config.motion == "laplacian":
            self.motion = LaplacianMotion(static, config, generator)
        elif ours:
            self.motion = TimeMotion(static, config.width, generator)
        self.appearance = zero_head(shapes["appearance.weight"]) if config.appearance_size else None

    @property
    def grids(self) -> list[HashGrid]:
        """All hash grids, the spatial one first."""
        return [self.static_grid, *(grid for grid in self.temporal_grids if isinstance(grid, HashGrid))]

    def forward(
        self, means: Tensor, t: float, dynamics: Tensor | None = None, nearby: Nearby | None = None
    ) -> Deformation:
        """See motion/fields/deformation.py."""
        return self.at_times(means, t, dynamics, nearby)[0]

    def at_times(
        self,
        means: Tensor,
        t: float,
        dynamics: Tensor | None = None,
        nearby: Nearby | None = None,
        time_samples: TimeSamples | None = None,
    ) -> list[Deformation]:
        """See motion/fields/deformation.py. All are encoded together, which takes much less time than apart."""
        now, *others, sq_distances = self._outputs(means, t, dynamics, nearby, time_samples)
        smoothness = _smoothness(sq_distances, nearby) if nearby is not None else None
        return [self._deformation(now)._replace(smoothness=smoothness), *map(self._deformation, others)]

    def _deformation(self, outputs: Tensor) -> Deformation:
        geometry, look = outputs[:, : sum(GEOMETRY)], outputs[:, sum(GEOMETRY) :] if self.appearance else None
        turn, shift, d_quats, d_scales = geometry.split(GEOMETRY, dim=1)
        rotation = nn.functional.normalize(turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=1)
        return Deformation(
            rotation,
            shift,
            d_quats,
            d_scales,
            look[:, :3] if look is not None else None,
            look[:, 3] if look is not None and look.shape[1] > 3 else None,
        )

    def _outputs(
        self, means: Tensor, t: float, dynamics: Tensor | None, nearby: Nearby | None, time_samples: TimeSamples | None
    ) -> list[Tensor]:
        """Return outputs of the geometry heads (N, 14) and, in further columns, of the appearance head.

        The same (M, 14) of each sampled time follow; then the sums of the squared differences between features of
        nearby points, for spatial and for space-time features.
        """
        places = [(means, self.config.grid_time(t))]
        if nearby is not None:
            places.append((means[nearby.rows] + nearby.offsets, self.config.grid_time(nearby.time)))
        decoded = [(t, dynamics)]
        if time_samples is not None:
            their_means, their_dynamics = time_samples.chosen(means, dynamics)
            places += [(their_means, self.config.grid_time(time)) for time in time_samples.times]
            decoded += [(time, their_dynamics) for time in time_samples.times]
        here, *others = self._encoder.encode_all(places)
        sq_distances = []
        if nearby is not None:
            near, *others = others
            sq_distances = [(b - a[nearby.rows]).square().sum() for a, b in zip(here, near, strict=True)]
        outputs = [self._decode(*given, *each) for given, each in zip(decoded, [here, *others], strict=True)]
        return [*outputs, torch.stack(sq_distances) if sq_distances else means.new_zeros(0)]

    def _decode(self, t: float, dynamics: Tensor | None, static: Tensor, temporal: Tensor | None = None) -> Tensor:
        """Return the outputs of the geometry heads (N, 14) and, in further columns, of the appearance head."""
        count, size = len(static), self.config.dynamics_size
        temporal = static.new_zeros(count, 0) if temporal is None else temporal
        inputs = static, temporal, dynamics if size and dynamics is not None else static.new_zeros(count, size)
        if not len(self.hidden):
            return decode(*inputs, self._weights(t))
        # In blocks, which avoids large allocations. For many Gaussians the backward pass computes them again: the
        # activations, 4 KB per Gaussian at a width of 256, would be most of a training's memory.
        decode_block = self._decode_hidden
        if len(static) > KEPT:
            decode_block = partial(checkpoint, decode_block, use_reentrant=False, preserve_rng_state=False)
        blocks = zip(*(part.split(_BLOCK) for part in inputs), strict=True)
        return torch.cat([decode_block(t, *block) for block in blocks])

    def _decode_hidden(self, t: float, static: Tensor, temporal: Tensor, dynamics: Tensor) -> Tensor:
        """Return the same after the hidden layers: `decode` gives what these read, and the gated channels, which the
        appearance head reads."""
        fused, *gated = decode(static, temporal, dynamics, self._weights(t)).split(self.config.width, dim=1)
        outputs = [self.heads(self.hidden(fused))]
        if self.appearance is not None:
            outputs.append(self.appearance(*gated))
        return torch.cat(outputs, dim=1) * self._head_factors()

    def _weights(self, t: float) -> DecoderWeights:
        """Return the decoder's weights at a time.

        The second layer of the motion, which only linear layers follow, is folded into the heads, and all heads are one
        matrix, so that the features' gradient (N, width) is written once. Before hidden layers the heads are the
        identity.
        """
        size = self.config.dynamics_size
        if len(self.hidden):
            identity, moved = torch.eye(self.config.width), self.config.width
            heads = torch.cat([identity] if self.appearance is None else [identity, identity])
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

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """See motion/fields/deformation.py. The spectrum's frequencies, in no group, have their own optimizer."""
        tables = [grid.table for grid in self.grids]
        excluded = {id(table) for table in tables}
        if isinstance(self.motion, LaplacianMotion):
            excluded.add(id(self.motion.frequencies))
        return {"hash": tables, "mlp": [p for p in self.parameters() if id(p) not in excluded]}


def _smoothness(sq_distances: Tensor, nearby: Nearby) -> Tensor:
    """Grid4D's smoothness loss: the mean squared distance between the features of near places, static and temporal."""
    weights = sq_distances.new_tensor([nearby.static_weight, nearby.temporal_weight][: len(sq_distances)])
    return (weights * sq_distances).sum() / max(1, len(nearby.rows))
