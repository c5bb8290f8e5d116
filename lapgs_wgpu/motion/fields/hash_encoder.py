"""The hash encoder as torch sees it: grids whose tables belong to torch, their encoding and its gradient on the device
(motion/passes/hash_encoder_passes), and its plain-torch twin."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ...gpu.buffer import Buffer, BufferPool, Request, read_all
from ...gpu.device import Device
from ...gpu.kernel import Commands
from ..passes.hash_encoder_passes import HashEncoderPasses
from .hash_grid_config import TIME, GridShape, HashConfig

Place = tuple[Tensor, float]  # points (N, 3), world units, and a time in [0, 1]
_NUMPY = {torch.float32: "float32", torch.bfloat16: "int16"}  # as which numpy, which has no bfloat16, takes them


class HashGrid(GridShape, nn.Module):
    """A grid with its table: (entries, 2) float32."""

    def __init__(self, config: HashConfig, axes: tuple[int, int, int], generator: torch.Generator) -> None:
        nn.Module.__init__(self)
        GridShape.__init__(self, config, axes)
        self.table = nn.Parameter(torch.empty(self.entries, 2).uniform_(-1e-4, 1e-4, generator=generator))


class HashEncoder:
    """Encodes points with several grids at once on one device. Axes and levels are fixed; tables come with each call.

    groups: of grids whose features lie beside one another in one encoding.
    lane_levels: the shape of the backward pass for CPU devices; otherwise fixed-point atomics.
    """

    def __init__(
        self,
        device: Device,
        groups: Sequence[Sequence[HashGrid]],
        bound: float,
        *,
        lane_levels: bool | None = None,
    ) -> None:
        self.groups = [list(group) for group in groups]
        self._encoders = [HashEncoderPasses(device, group, bound, lane_levels=lane_levels) for group in self.groups]
        self._pool = BufferPool(device)
        self.written: object = None  # another one with each `write`, whose encodings are on the device until the next

    @property
    def grids(self) -> list[HashGrid]:
        """Those of all groups."""
        return [grid for group in self.groups for grid in group]

    @property
    def features(self) -> list[int]:
        """Of a point, for each group."""
        return [sum(grid.features for grid in group) for group in self.groups]

    def __call__(self, points: Tensor, time: float = 0.0, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        """Encode points (N, 3), world units, at a time in [0, 1]: an (N, features) tensor for each group.

        Differentiable in the tables, not in the points (the encoder sees sg[mean]). A point outside the box
        [-bound, bound]^3 has zero features. dtype: of the encodings and of their gradients, float32 or bfloat16, to
        which sums in float32 are rounded; the tables and their gradients are float32.
        """
        return self.encode_all([(points, time)], dtype)[0]

    def encode_all(self, places: Sequence[Place], dtype: torch.dtype = torch.float32) -> list[list[Tensor]]:
        """Encode several sets of points, each at its own time, and exchange the tables with the device only once."""
        detached = [(points.detach(), time) for points, time in places]
        outputs = _Encode.apply(self, detached, dtype, *[grid.table for grid in self.grids])
        count = len(self.groups)
        return [list(outputs[i : i + count]) for i in range(0, len(outputs), count)]

    def encode(self, places: Sequence[Place], dtype: torch.dtype, tables: Sequence[Tensor]) -> list[Tensor]:
        """The forward pass without autograd: the encodings of the first place, group by group, then of the second."""
        self.write(places, tables)
        with Commands(self._pool.device) as commands:
            self.record(commands, places, dtype)
        requests: list[Request] = [
            (buffer, _NUMPY[dtype], (len(points), size), 0)
            for number, (points, _) in enumerate(places)
            for buffer, size in zip(self.encodings(number), self.features, strict=True)
        ]
        device = places[0][0].device
        return [torch.from_numpy(array).view(dtype).to(device) for array in read_all(requests)]

    def backward(self, places: Sequence[Place], d_encodings: Sequence[Tensor], written: object = None) -> list[Tensor]:
        """The gradients of the tables, from those of the encodings in the order of `encode`. written: what that left in
        `self.written`; while it is there, so are the points."""
        if written is None or written is not self.written:
            self.write(places)
        self.written = None  # encodings and tables become gradients
        for i, d_encoding in enumerate(d_encodings):
            number, group = divmod(i, len(self.groups))
            self._upload(f"encoding {number} {group}", d_encoding)
        with Commands(self._pool.device) as commands:
            requests = self.record_gradient(commands, places, d_encodings[0].dtype)
        return [torch.from_numpy(array).to(places[0][0].device) for array in read_all(requests)]

    # What `encode` and `backward` consist of, without waiting for the device. Everything is written before anything is
    # submitted: a buffer can only be mapped while the device rests.

    def write(self, places: Sequence[Place], tables: Sequence[Tensor] = ()) -> None:
        """Bring points, and tables, to the device."""
        self.written = object()
        for i, table in enumerate(tables):
            self._upload(f"table {i}", table)
        for number, (points, _) in enumerate(places):
            self._upload(f"points {number}", torch.nn.functional.pad(points.detach().float(), (0, 1)))

    def encodings(self, number: int) -> list[Buffer]:
        """Those of a set of points, group by group; with `record_gradient` what holds their gradients."""
        return [self._pool.get(f"encoding {number} {i}", 0) for i in range(len(self.groups))]

    def record(self, commands: Commands, places: Sequence[Place], dtype: torch.dtype = torch.float32) -> None:
        """The passes that encode what was written."""
        tables = self._tables()
        for number, (points, time) in enumerate(places):
            for i, (encoder, size) in enumerate(zip(self._encoders, self.features, strict=True)):
                encoding = self._pool.get(f"encoding {number} {i}", dtype.itemsize * len(points) * size)
                if len(points):
                    mine = self._pool.get(f"points {number}", 0), len(points), time, tables[i], encoding
                    encoder.encode(commands, number, *mine, bfloat16=dtype == torch.bfloat16)

    def record_gradient(
        self, commands: Commands, places: Sequence[Place], dtype: torch.dtype = torch.float32
    ) -> list[Request]:
        """The passes that make the gradients of the tables, in the tables' buffers, of those of the encodings, in the
        encodings' buffers; what to read to have them."""
        tables = self._tables()
        for buffer in itertools.chain(*tables):
            commands.clear(buffer)
        for number, (points, time) in enumerate(places):
            for i, encoder in enumerate(self._encoders):
                if len(points):
                    mine = (
                        self._pool.get(f"points {number}", 0),
                        len(points),
                        time,
                        self.encodings(number)[i],
                        tables[i],
                    )
                    encoder.add_gradient(commands, number, *mine, bfloat16=dtype == torch.bfloat16)
        shapes = [tuple(grid.table.shape) for grid in self.grids]
        return [(b, "float32", shape, 0) for b, shape in zip(itertools.chain(*tables), shapes, strict=True)]

    def _tables(self) -> list[list[Buffer]]:
        """The tables' buffers, group by group."""
        numbers = itertools.count()
        return [
            [self._pool.get(f"table {next(numbers)}", 8 * len(grid.table)) for grid in group] for group in self.groups
        ]

    def _upload(self, name: str, tensor: Tensor) -> Buffer:
        words = tensor.detach().to("cpu").contiguous()
        array = words.view(torch.int16).numpy() if words.dtype == torch.bfloat16 else words.float().numpy()
        buffer = self._pool.get(name, array.nbytes)
        buffer.write(array)
        return buffer


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, encoder: HashEncoder, places: Sequence[Place], dtype: torch.dtype, *tables: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.encoder, ctx.times = encoder, [time for _, time in places]
        ctx.save_for_backward(*[points for points, _ in places])
        encodings = encoder.encode(places, dtype, tables)
        ctx.written = encoder.written
        return tuple(encodings)

    @staticmethod
    def backward(ctx: Any, *d_encodings: Tensor) -> tuple[Tensor | None, ...]:
        places = list(zip(ctx.saved_tensors, ctx.times, strict=True))
        return (None, None, None, *ctx.encoder.backward(places, d_encodings, ctx.written))


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
