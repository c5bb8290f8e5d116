"""The hash encoder as torch sees it: grids whose tables belong to torch; encoding and gradient run on the device
(motion/passes/hash_encoder_passes)."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.motion.fields.config import GridShape, HashConfig
from lapgs_wgpu.motion.passes.hash_encoder_passes import HashEncoderPasses, PointSet

Place = tuple[Tensor, float]  # points (N, 3), world units, and a time in [0, 1]


class HashGrid(GridShape, nn.Module):
    """A hash grid with its table (entries, 2), float32."""

    def __init__(self, config: HashConfig, axes: tuple[int, int, int], generator: torch.Generator) -> None:
        nn.Module.__init__(self)
        GridShape.__init__(self, config, axes)
        self.table = nn.Parameter(torch.empty(self.entries, 2).uniform_(-1e-4, 1e-4, generator=generator))


class HashEncoder:
    """Encodes points with several grids on one device. Axes and levels are fixed; tables are read at each call.

    groups: the features of the grids of a group are concatenated to one encoding.
    """

    def __init__(self, device: Device, groups: Sequence[Sequence[HashGrid]], bound: float) -> None:
        self.grids: list[HashGrid] = []
        self._passes: list[HashEncoderPasses] = []
        for group in groups:
            self._passes.append(HashEncoderPasses(device, group, bound, first_table=len(self.grids)))
            self.grids += group
        self._pool = BufferPool(device)
        self._device = device

    def encode_all(self, places: Sequence[Place]) -> list[list[Tensor]]:
        """Encode sets of points, each at its own time: of each an (N, features) float32 tensor for each group.

        Differentiable in the tables, not in the points. Outside the box [-bound, bound]^3 the features are zero.
        """
        detached = [(points.detach(), time) for points, time in places]
        outputs = _Encode.apply(self, detached, *[grid.table for grid in self.grids])
        count = len(self._passes)
        return [list(outputs[i : i + count]) for i in range(0, len(outputs), count)]

    def encode(self, places: Sequence[Place]) -> list[Tensor]:
        """Return the encodings by place, then by group, without autograd."""
        tables, sets = self._tables(), self._sets(places)
        for array, grid in zip(tables, self.grids, strict=True):
            array.write(grid.table.numpy(force=True))
        with Commands(self._device) as commands:
            for passes, points, encoding in sets:
                passes.encode(commands, points, tables, encoding)
        return [torch.from_numpy(found) for found in read_all([encoding for _, _, encoding in sets])]

    def backward(self, places: Sequence[Place], d_encodings: Sequence[Tensor]) -> list[Tensor]:
        """Return the gradients of the tables from those of the encodings, in the order of `encode`."""
        d_tables, sets = self._tables(), self._sets(places)
        for (_, _, array), values in zip(sets, d_encodings, strict=True):
            array.write(values.numpy(force=True))
        with Commands(self._device) as commands:
            for table in d_tables:
                commands.clear(table)
            for passes, points, d_encoding in sets:
                passes.add_gradient(commands, points, d_encoding, d_tables)
        return [torch.from_numpy(found) for found in read_all(d_tables)]

    def _tables(self) -> list[DeviceArray]:
        """Arrays for the tables of all grids, or for their gradients."""
        return [self._pool.array(f"table {i}", tuple(grid.table.shape)) for i, grid in enumerate(self.grids)]

    def _sets(self, places: Sequence[Place]) -> list[tuple[HashEncoderPasses, PointSet, DeviceArray]]:
        """Upload points; of each place and group the passes, the points, and an array (N, features) for the encoding or
        for its gradient.

        All writes precede the submission: a buffer can only be mapped while the device does not use it.
        """
        sets = []
        for number, (points, time) in enumerate(places):
            array = self._pool.upload(f"points {number}", nn.functional.pad(points.float(), (0, 1)).numpy())
            uploaded = PointSet(number, array, len(points), partial(float, time))
            for group, passes in enumerate(self._passes):
                encoding = self._pool.array(f"encoding {number} {group}", (len(points), passes.features))
                sets.append((passes, uploaded, encoding))
        return sets


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, encoder: HashEncoder, places: Sequence[Place], *_: Tensor) -> tuple[Tensor, ...]:
        ctx.encoder, ctx.places = encoder, places
        return tuple(encoder.encode(places))

    @staticmethod
    def backward(ctx: Any, *d_encodings: Tensor) -> tuple[Tensor | None, ...]:
        return (None, None, *ctx.encoder.backward(ctx.places, d_encodings))
