"""The hash encoder as torch sees it: grids whose tables belong to torch; encoding and gradient run on the device
(motion/passes/hash_encoder_passes)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.hash_grid_config import GridShape, HashConfig
from lapgs_wgpu.motion.passes.hash_encoder_passes import HashEncoderPasses, PointSet

Place = tuple[Tensor, float]  # points (N, 3), world units, and a time in [0, 1]


class HashGrid(GridShape, nn.Module):
    """A hash grid with its table (entries, 2), float32."""

    def __init__(self, config: HashConfig, axes: tuple[int, int, int], generator: torch.Generator) -> None:
        nn.Module.__init__(self)
        GridShape.__init__(self, config, axes)
        self.table = nn.Parameter(torch.empty(self.entries, 2).uniform_(-1e-4, 1e-4, generator=generator))


class HashEncoder:
    """Encodes points with several grids on one device. Axes and levels are fixed; tables are passed to each call.

    groups: the features of the grids of a group are concatenated to one encoding.
    lane_levels: use the backward pass for CPU devices; otherwise fixed-point atomics.
    """

    def __init__(
        self,
        device: Device,
        groups: Sequence[Sequence[HashGrid]],
        bound: float,
        *,
        lane_levels: bool | None = None,
    ) -> None:
        self.grids = [grid for group in groups for grid in group]
        self._passes = [HashEncoderPasses(device, group, bound, lane_levels=lane_levels) for group in groups]
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

    def encode(self, places: Sequence[Place], tables: Sequence[Tensor]) -> list[Tensor]:
        """Return the encodings by place, then by group, without autograd."""
        arrays, sets = self._tables(), self._upload(places)
        for array, table in zip(arrays, tables, strict=True):
            array.write(_host(table))
        with Commands(self._device) as commands:
            for passes, points, of_group, encoding in self._by_group(sets, arrays):
                passes.encode(commands, points, of_group, encoding)
        return _read([array for _, encodings in sets for array in encodings], places)

    def backward(self, places: Sequence[Place], d_encodings: Sequence[Tensor]) -> list[Tensor]:
        """Return the gradients of the tables from those of the encodings, in the order of `encode`."""
        arrays, sets = self._tables(), self._upload(places)
        given = iter(d_encodings)
        for _, encodings in sets:
            for array in encodings:
                array.write(_host(next(given)))
        with Commands(self._device) as commands:
            for array in arrays:
                commands.clear(array)
            for passes, points, of_group, encoding in self._by_group(sets, arrays):
                passes.add_gradient(commands, points, encoding, of_group)
        return _read(arrays, places)

    def _tables(self) -> list[DeviceArray]:
        """Arrays for the tables of all grids, or for their gradients."""
        return [self._pool.array(f"table {i}", tuple(grid.table.shape)) for i, grid in enumerate(self.grids)]

    def _upload(self, places: Sequence[Place]) -> list[tuple[PointSet, list[DeviceArray]]]:
        """Upload points; with each set an array (N, features) for the encoding of each group, or for its gradient.

        All writes precede the submission: a buffer can only be mapped while the device does not use it.
        """
        sets = []
        for number, (points, time) in enumerate(places):
            padded = _host(torch.nn.functional.pad(points.detach().float(), (0, 1)))
            uploaded = PointSet(
                number, self._pool.upload(f"points {number}", padded), len(points), partial(float, time)
            )
            shapes = [(len(points), sum(grid.features for grid in passes.grids)) for passes in self._passes]
            encodings = [self._pool.array(f"encoding {number} {group}", shape) for group, shape in enumerate(shapes)]
            sets.append((uploaded, encodings))
        return sets

    def _by_group(
        self, sets: Sequence[tuple[PointSet, list[DeviceArray]]], tables: Sequence[DeviceArray]
    ) -> Iterator[tuple[HashEncoderPasses, PointSet, list[DeviceArray], DeviceArray]]:
        """Passes, points, tables and encoding of each set and group, but of sets without points."""
        for points, encodings in sets:
            rest = iter(tables)
            for passes, encoding in zip(self._passes, encodings if points.count else (), strict=False):
                yield passes, points, list(itertools.islice(rest, len(passes.grids))), encoding


def _read(arrays: Sequence[DeviceArray], places: Sequence[Place]) -> list[Tensor]:
    """The content of arrays, as tensors where the points are."""
    return [torch.from_numpy(array).to(places[0][0].device) for array in read_all(arrays)]


def _host(tensor: Tensor) -> NDArray[np.float32]:
    return tensor.detach().to("cpu", torch.float32).contiguous().numpy()


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, encoder: HashEncoder, places: Sequence[Place], *tables: Tensor) -> tuple[Tensor, ...]:
        ctx.encoder, ctx.times = encoder, [time for _, time in places]
        ctx.save_for_backward(*[points for points, _ in places])
        return tuple(encoder.encode(places, tables))

    @staticmethod
    def backward(ctx: Any, *d_encodings: Tensor) -> tuple[Tensor | None, ...]:
        places = list(zip(ctx.saved_tensors, ctx.times, strict=True))
        return (None, None, *ctx.encoder.backward(places, d_encodings))
