"""The hash encoder on the device: encoding points with several hash grids, and the gradient of their tables.

The tables belong to torch; the kernels run on the device. A step has one time, so a grid with a time axis is first
cut at that time wherever that is cheaper than looking up the planes around it for each point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..gpu.buffer import Buffer, BufferPool, Request, read_all
from ..gpu.device import Device
from ..gpu.kernel import Commands, Kernel
from .hashgrid import HashGrid

_DISPATCH_POINTS = 1 << 15  # with lane_levels: Mesa's software driver ends a shader's loops after 65,535 rounds
_LEVEL_WORDS = 12  # common/hashgrid.wgsl: struct Level

Place = tuple[Tensor, float]  # points (N, 3), world units, and a time in [0, 1]


@dataclass(frozen=True)
class _Part:
    """Some levels of a grid that are handled alike."""

    grid: int
    sliced: bool
    count: int
    levels: Buffer
    cells: int  # of the largest plane
    entries: int  # of all slices together


class HashEncoder:
    """Encodes points with several grids at once on one device. axes and levels are fixed; tables come with each call.

    lane_levels: the shape of the backward pass for CPU devices; otherwise fixed-point atomics.
    """

    def __init__(self, device: Device, grids: list[HashGrid], bound: float, *, lane_levels: bool | None = None) -> None:
        self.device, self.grids, self.bound = device, grids, bound
        self.pool = BufferPool(device)
        self._lane_levels = device.is_cpu if lane_levels is None else lane_levels
        self._parts: list[_Part] = []
        for number, grid in enumerate(grids):
            sliced = grid.sliced
            direct = [i for i in range(len(grid.levels)) if i not in sliced]
            for chosen, cut in ((sliced, True), (direct, False)):
                if chosen:
                    self._parts.append(self._part(number, chosen, cut))

    def _part(self, number: int, chosen: list[int], sliced: bool) -> _Part:
        levels = self.grids[number].levels
        words = np.zeros((len(chosen), _LEVEL_WORDS), np.uint32)
        slices = largest = 0
        for row, i in zip(words, chosen, strict=True):
            level = levels[i]
            row[:3] = np.asarray(level.scale, np.float32).view(np.uint32)
            row[4:8] = (*level.resolution, level.entries)
            row[8:12] = (level.first, slices, i, level.dense)
            cells = level.resolution[0] * level.resolution[1]
            largest = max(largest, cells)
            slices += cells
        buffer = Buffer(self.device, words.nbytes, f"levels {number} {'sliced' if sliced else 'direct'}")
        buffer.write(words)
        return _Part(number, sliced, len(chosen), buffer, largest, slices if sliced else 0)

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

    # One call on the device -----------------------------------------------------------------------------------------

    def _uniform(
        self, part: _Part, number: int, points: int, time: float, fixed_scale: float = 1.0, first: int = 0
    ) -> Buffer:
        """What the kernels are told of the place of this number; all places of a call are submitted at once."""
        axes = self.grids[part.grid].axes
        content = Kernel.get(self.device, "hashgrid_slice", SLICED=1, CORNERS=4).uniform(
            "Grid",
            points=points,
            levels=part.count,
            all_levels=len(self.grids[part.grid].levels),
            first_point=first,
            last_point=min(points, first + _DISPATCH_POINTS),
            axes=(*axes, 0),
            time=time,
            bound=self.bound,
            fixed_scale=fixed_scale,
        )
        return self.pool.constant(f"grid {part.grid} {part.sliced} place {number} from {first}", content)

    @staticmethod
    def _defines(part: _Part) -> dict[str, int]:
        return {"SLICED": 1, "CORNERS": 4} if part.sliced else {"CORNERS": 8}

    def encode(self, places: Sequence[Place], tables: Sequence[Tensor]) -> list[Tensor]:
        """The forward pass without autograd: the encodings of the first place, grid by grid, then of the second, ..."""
        # Everything is written before anything is submitted: a buffer can only be mapped while the device rests.
        table_buffers = [self._upload(f"table {i}", table) for i, table in enumerate(tables)]
        point_buffers = [self._points(number, points) for number, (points, _) in enumerate(places)]
        requests: list[Request] = []
        with Commands(self.device) as commands:
            for number, (points, time) in enumerate(places):
                n = len(points)
                outputs = [
                    self.pool.get(f"encoding {number} {i}", 4 * n * grid.features) for i, grid in enumerate(self.grids)
                ]
                requests += [(b, "float32", (n, g.features), 0) for b, g in zip(outputs, self.grids, strict=True)]
                if n:
                    self._encode_place(commands, number, point_buffers[number], n, time, table_buffers, outputs)
        device = places[0][0].device
        return [torch.from_numpy(array).to(device) for array in read_all(requests)]

    def _encode_place(
        self,
        commands: Commands,
        number: int,
        points: Buffer,
        n: int,
        time: float,
        tables: list[Buffer],
        outputs: list[Buffer],
    ) -> None:
        for part in self._parts:
            uniform = self._uniform(part, number, n, time)
            features = tables[part.grid]
            defines = self._defines(part)
            if part.sliced:
                slices = self.pool.get(f"slices {part.grid}", 8 * part.entries)
                commands.dispatch_grid(
                    Kernel.get(self.device, "hashgrid_slice", **defines),
                    (-(-part.cells // 64), part.count),
                    grid=uniform,
                    levels=part.levels,
                    features=features,
                    slices=slices,
                )
                features = slices
            commands.dispatch(
                Kernel.get(self.device, "hashgrid", **defines),
                -(-n // 512) * part.count,
                grid=uniform,
                levels=part.levels,
                points=points,
                features=features,
                encoding=outputs[part.grid],
            )

    def backward(self, places: Sequence[Place], d_encodings: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of the tables, from those of the encodings in the order of `encode`."""
        count = len(self.grids)
        d_tables = [self.pool.get(f"d_table {i}", 8 * len(grid.table)) for i, grid in enumerate(self.grids)]
        point_buffers = [self._points(number, points) for number, (points, _) in enumerate(places)]
        d_buffers = [self._upload(f"d_encoding {i // count} {i % count}", d) for i, d in enumerate(d_encodings)]
        with Commands(self.device) as commands:
            for buffer in d_tables:
                commands.clear(buffer)
            for number, (points, time) in enumerate(places):
                if len(points):
                    mine = slice(number * count, (number + 1) * count)
                    scale = 1.0 if self._lane_levels else _fixed_scale(d_encodings[mine], len(points))
                    buffer, n = point_buffers[number], len(points)
                    self._add_place(commands, number, buffer, n, time, scale, d_buffers[mine], d_tables)
        arrays = read_all([(b, "float32", tuple(g.table.shape), 0) for b, g in zip(d_tables, self.grids, strict=True)])
        return [torch.from_numpy(array).to(places[0][0].device) for array in arrays]

    def _add_place(
        self,
        commands: Commands,
        number: int,
        points: Buffer,
        n: int,
        time: float,
        fixed_scale: float,
        d_encodings: list[Buffer],
        d_tables: list[Buffer],
    ) -> None:
        for part in self._parts:
            inputs = {
                "grid": self._uniform(part, number, n, time, fixed_scale),
                "levels": part.levels,
                "points": points,
                "d_encoding": d_encodings[part.grid],
            }
            target = d_tables[part.grid]
            if part.sliced:
                target = self.pool.get(f"d_slices {part.grid}", 8 * part.entries)
                commands.clear(target)
            if self._lane_levels:
                self._add_lanes(commands, part, number, n, time, inputs, target)
            else:
                self._add_fixed(commands, part, n, inputs, target)
            if part.sliced:
                commands.dispatch_grid(
                    Kernel.get(self.device, "hashgrid_slice_bwd", **self._defines(part)),
                    (-(-part.cells // 64), part.count),
                    grid=inputs["grid"],
                    levels=part.levels,
                    d_slices=target,
                    d_features=d_tables[part.grid],
                )

    def _add_lanes(
        self, commands: Commands, part: _Part, number: int, n: int, time: float, inputs: dict[str, Buffer], out: Buffer
    ) -> None:
        kernel = Kernel.get(self.device, "hashgrid_bwd", LANE_LEVELS=1, **self._defines(part))
        for first in range(0, n, _DISPATCH_POINTS):
            inputs["grid"] = self._uniform(part, number, n, time, first=first)
            commands.dispatch(kernel, -(-part.count // 8), **inputs, d_features=out)

    def _add_fixed(self, commands: Commands, part: _Part, n: int, inputs: dict[str, Buffer], out: Buffer) -> None:
        fixed = self.pool.get(f"d_fixed {part.grid} {part.sliced}", 2 * out.nbytes)
        commands.clear(fixed)
        kernel = Kernel.get(self.device, "hashgrid_bwd", **self._defines(part))
        commands.dispatch(kernel, -(-n // 64) * part.count, **inputs, d_fixed=fixed)
        unfix = Kernel.get(self.device, "hashgrid_unfix", **self._defines(part))
        commands.dispatch(unfix, -(-out.nbytes // 256), grid=inputs["grid"], d_fixed=fixed, d_features=out)

    def _points(self, number: int, points: Tensor) -> Buffer:
        return self._upload(f"points {number}", torch.nn.functional.pad(points, (0, 1)))

    def _upload(self, name: str, tensor: Tensor) -> Buffer:
        array = tensor.detach().to("cpu", torch.float32).contiguous().numpy()
        buffer = self.pool.get(name, array.nbytes)
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
