"""The hash encoder as torch sees it: grids whose tables belong to torch, their encoding and its gradient on the device
(motion/device_encoder), and its plain-torch twin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ..gpu.buffer import Buffer, Request, read_all
from ..gpu.device import Device
from ..gpu.kernel import Commands
from .device_encoder import DeviceEncoder
from .hashgrid import TIME, GridShape, HashConfig

Place = tuple[Tensor, float]  # points (N, 3), world units, and a time in [0, 1]


class HashGrid(GridShape, nn.Module):
    """A grid with its table: (entries, 2) float32."""

    def __init__(self, config: HashConfig, axes: tuple[int, int, int], generator: torch.Generator) -> None:
        nn.Module.__init__(self)
        GridShape.__init__(self, config, axes)
        self.table = nn.Parameter(torch.empty(self.entries, 2).uniform_(-1e-4, 1e-4, generator=generator))


class HashEncoder:
    """Encodes points with several grids at once on one device. axes and levels are fixed; tables come with each call.

    lane_levels: the shape of the backward pass for CPU devices; otherwise fixed-point atomics.
    """

    def __init__(self, device: Device, grids: list[HashGrid], bound: float, *, lane_levels: bool | None = None) -> None:
        self.grids = grids
        self._encoder = DeviceEncoder(device, grids, bound, lane_levels=lane_levels)
        self._pool = self._encoder.pool

    def __call__(self, points: Tensor, time: float = 0.0) -> list[Tensor]:
        """Encode points (N, 3), world units, at a time in [0, 1]: one (N, 2 x levels) tensor a grid.

        Differentiable in the tables, not in the points (the encoder sees sg[mean]). A point outside the box
        [-bound, bound]^3 has zero features.
        """
        return self.encode_all([(points, time)])[0]

    def encode_all(self, places: Sequence[Place]) -> list[list[Tensor]]:
        """Encode several sets of points, each at its own time, and exchange the tables with the device only once."""
        detached = [(points.detach(), time) for points, time in places]
        outputs = _Encode.apply(self, detached, *[grid.table for grid in self.grids])
        count = len(self.grids)
        return [list(outputs[i : i + count]) for i in range(0, len(outputs), count)]

    def encode(self, places: Sequence[Place], tables: Sequence[Tensor]) -> list[Tensor]:
        """The forward pass without autograd: the encodings of the first place, grid by grid, then of the second, ..."""
        # Everything is written before anything is submitted: a buffer can only be mapped while the device rests.
        table_buffers = [self._upload(f"table {i}", table) for i, table in enumerate(tables)]
        point_buffers = [self._points(number, points) for number, (points, _) in enumerate(places)]
        requests: list[Request] = []
        with Commands(self._encoder.device) as commands:
            for number, (points, time) in enumerate(places):
                n = len(points)
                outputs = [
                    self._pool.get(f"encoding {number} {i}", 4 * n * grid.features) for i, grid in enumerate(self.grids)
                ]
                requests += [(b, "float32", (n, g.features), 0) for b, g in zip(outputs, self.grids, strict=True)]
                if n:
                    self._encoder.encode(commands, number, point_buffers[number], n, time, table_buffers, outputs)
        device = places[0][0].device
        return [torch.from_numpy(array).to(device) for array in read_all(requests)]

    def backward(self, places: Sequence[Place], d_encodings: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of the tables, from those of the encodings in the order of `encode`."""
        count = len(self.grids)
        d_tables = [self._pool.get(f"d_table {i}", 8 * len(grid.table)) for i, grid in enumerate(self.grids)]
        point_buffers = [self._points(number, points) for number, (points, _) in enumerate(places)]
        d_buffers = [self._upload(f"d_encoding {i // count} {i % count}", d) for i, d in enumerate(d_encodings)]
        with Commands(self._encoder.device) as commands:
            for buffer in d_tables:
                commands.clear(buffer)
            for number, (points, time) in enumerate(places):
                if len(points):
                    mine = slice(number * count, (number + 1) * count)
                    scale = 1.0 if self._encoder.lane_levels else _fixed_scale(d_encodings[mine], len(points))
                    buffer, n = point_buffers[number], len(points)
                    self._encoder.add_gradient(commands, number, buffer, n, time, scale, d_buffers[mine], d_tables)
        arrays = read_all([(b, "float32", tuple(g.table.shape), 0) for b, g in zip(d_tables, self.grids, strict=True)])
        return [torch.from_numpy(array).to(places[0][0].device) for array in arrays]

    def _points(self, number: int, points: Tensor) -> Buffer:
        return self._upload(f"points {number}", torch.nn.functional.pad(points, (0, 1)))

    def _upload(self, name: str, tensor: Tensor) -> Buffer:
        array = tensor.detach().to("cpu", torch.float32).contiguous().numpy()
        buffer = self._pool.get(name, array.nbytes)
        buffer.write(array)
        return buffer


def _fixed_scale(gradients: Sequence[Tensor], points: int) -> float:
    """By which gradients are multiplied in fixed point: the largest sum that can occur stays below 2^61."""
    largest = max(float(gradient.abs().max()) for gradient in gradients)
    if largest == math.inf:
        return 1.0
    return 2.0 ** min(120, math.floor(61 - math.log2(max(largest, 1e-30) * points)))


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


def encode_reference(grid: HashGrid, table: Tensor, points: Tensor, time: float, bound: float) -> Tensor:
    """The plain-torch twin: (N, 2 x levels) in the table's precision; cells are found in float32 as on the device."""
    columns = [(points[:, axis] + bound) / (2 * bound) if axis != TIME else None for axis in grid.axes]
    unit = torch.stack([torch.full_like(points[:, 0], time) if c is None else c for c in columns], dim=1)
    inside = ((unit >= 0) & (unit <= 1)).all(dim=1)
    primes = (1, 2654435761, 805459861)
    encodings = []
    for level, rows in zip(grid.levels, table.split([level.entries for level in grid.levels]), strict=True):
        p = torch.where(inside[:, None], unit * torch.tensor(level.scale, dtype=unit.dtype), 0.0)
        low = p.floor()
        fraction = (p - low).to(table.dtype)
        up = fraction * fraction * (3 - 2 * fraction)
        base = low.long()
        total = table.new_zeros((len(points), 2))
        for corner in range(8):
            weight = inside.to(table.dtype)
            at = []
            for axis in range(3):
                high = (corner >> axis) & 1
                weight = weight * (up[:, axis] if high else 1 - up[:, axis])
                at.append((base[:, axis] + high).clamp(max=level.resolution[axis] - 1))
            x, y, z = at
            if level.dense:
                index = x + level.resolution[0] * (y + level.resolution[1] * z)
            else:
                hashed = [((a * prime) & 0xFFFFFFFF) for a, prime in zip(at, primes, strict=True)]
                index = (hashed[0] ^ hashed[1] ^ hashed[2]) % level.entries
            total = total + weight[:, None] * rows[index]
        encodings.append(total)
    return torch.cat(encodings, dim=1)
