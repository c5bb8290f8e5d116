"""Device passes of the hash encoder, without torch: lookup of points in several hash grids, and gradients of tables.

All points share one time. Levels of a grid with a time axis are first sliced at that time, if that is cheaper than
looking up two planes for each point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ...gpu.array import DeviceArray
from ...gpu.device import SOFTWARE_LOOP_TURNS, Device
from ...gpu.kernel import Commands, Kernel
from ...gpu.pool import BufferPool
from ..fields.hash_grid_config import GridShape

_ALIGNED = 64  # rows; a multiple of 256 bytes for every row size, at which a binding may begin
_LEVEL_WORDS = 12  # common/hashgrid.wgsl: struct Level


@dataclass(frozen=True)
class PointSet:
    """Points at one time.

    number: distinguishes the sets that are submitted together. array: (N, 4) world units. count: number of points to
    encode. time: in [0, 1].
    """

    number: int
    array: DeviceArray
    count: int
    time: float


@dataclass(frozen=True)
class _Part:
    """The levels of a grid that are sliced, or those that are not."""

    grid: int
    sliced: bool
    count: int
    levels: DeviceArray
    cells: int  # of the largest plane
    entries: int  # of all slices together


class HashEncoderPasses:
    """Records the passes that encode points with several grids. Axes and levels are fixed.

    lane_levels: use the backward pass for CPU devices; otherwise fixed-point atomics.
    row, column: the encoding's rows have `row` floats; the grids' features are written one after another from `column`
    on. Both are even. By default the rows hold the features only.
    """

    def __init__(
        self,
        device: Device,
        grids: Sequence[GridShape],
        bound: float,
        *,
        lane_levels: bool | None = None,
        row: int | None = None,
        column: int = 0,
    ) -> None:
        self.device, self.grids, self.bound = device, list(grids), bound
        self.pool = BufferPool(device)
        self.lane_levels = device.is_cpu if lane_levels is None else lane_levels
        # If a lane loops over all points: at most half of the iterations that the driver allows.
        turns = SOFTWARE_LOOP_TURNS if self.lane_levels else None
        self._most_points = None if turns is None else (turns + 1) // 2
        self._row = sum(grid.features for grid in grids) if row is None else row
        self._parts: list[_Part] = []
        for number, grid in enumerate(grids):
            sliced = grid.sliced
            direct = [i for i in range(len(grid.levels)) if i not in sliced]
            for chosen, cut in ((sliced, True), (direct, False)):
                if chosen:
                    self._parts.append(self._part(number, chosen, cut, column // 2))
            column += grid.features

    def _part(self, number: int, chosen: list[int], sliced: bool, first_pair: int) -> _Part:
        levels = self.grids[number].levels
        words = np.zeros((len(chosen), _LEVEL_WORDS), np.uint32)
        slices = largest = 0
        for row, i in zip(words, chosen, strict=True):
            level = levels[i]
            row[:3] = np.asarray(level.scale, np.float32).view(np.uint32)
            row[4:8] = (*level.resolution, level.entries)
            row[8:12] = (level.first, slices, first_pair + i, level.dense)
            cells = level.resolution[0] * level.resolution[1]
            largest = max(largest, cells)
            slices += cells
        array = DeviceArray.upload(self.device, f"levels {number} {'sliced' if sliced else 'direct'}", words)
        return _Part(number, sliced, len(chosen), array, largest, slices if sliced else 0)

    def _uniform(self, part: _Part, place: str, points: int, all_points: int, time: float) -> DeviceArray:
        """The uniform of a block of points. All blocks of all sets are submitted together, so each has its own."""
        content = Kernel.get(self.device, "hashgrid_slice", SLICED=1, CORNERS=4).uniform(
            "Grid",
            points=points,
            all_points=all_points,
            levels=part.count,
            all_levels=self._row // 2,
            axes=(*self.grids[part.grid].axes, 0),
            time=time,
            bound=self.bound,
        )
        return self.pool.constant(f"grid {part.grid} {part.sliced} place {place}", content)

    @staticmethod
    def _defines(part: _Part) -> dict[str, int]:
        return {"SLICED": 1, "CORNERS": 4} if part.sliced else {"CORNERS": 8}

    def _blocks(self, n: int, encoding: DeviceArray, most: int | None = None) -> Iterator[tuple[int, int]]:
        """First point and number of points of each dispatch: at most `most`, with rows that fit into a binding."""
        row = encoding.nbytes // max(n, 1)
        size = self.device.max_binding // max(row, 1) // _ALIGNED * _ALIGNED
        size = size if most is None else min(size, most)
        return ((first, min(size, n - first)) for first in range(0, n, size))

    def encode(
        self,
        commands: Commands,
        points: PointSet,
        tables: list[DeviceArray],
        encoding: DeviceArray,
        *,
        rows: DeviceArray | None = None,
    ) -> None:
        """Encode points; outside the box [-bound, bound]^3 features are zero.

        tables: (entries, 2) of each grid. encoding: (N, row), float32, or int16, which stands for bfloat16. rows:
        uint32, the first `points.count` select the points; the encoding, which must then fit into a binding, keeps its
        other rows.
        """
        number, n = points.number, points.count
        sources = []
        for part in self._parts:
            source = tables[part.grid]
            if part.sliced:
                slices = self.pool.array(f"slices {part.grid}", (part.entries, 2))
                kernel = Kernel.get(self.device, "hashgrid_slice", **self._defines(part))
                grid = self._uniform(part, f"{number}", n, n, points.time)
                arrays = {"grid": grid, "levels": part.levels, "features": source, "slices": slices}
                commands.dispatch_grid(kernel, (-(-part.cells // 64), part.count), **arrays)
                source = slices
            sources.append(source)
        options = _precision(encoding)
        if rows is None:
            blocks = [
                (first, count, {"points": points.array.rows(first, count), "encoding": encoding.rows(first, count)})
                for first, count in self._blocks(n, encoding)
            ]
        else:
            options |= {"ROWS": 1}
            blocks = [(0, n, {"points": points.array, "encoding": encoding, "rows": rows})]
        for first, count, of_points in blocks:
            for part, source in zip(self._parts, sources, strict=True):
                kernel = Kernel.get(self.device, "hashgrid", **self._defines(part), **options)
                grid = self._uniform(part, f"{number} from {first}", count, n, points.time)
                arrays = {"grid": grid, "levels": part.levels, "features": source}
                commands.dispatch(kernel, -(-count // 512) * part.count, **arrays, **of_points)

    def add_gradient(
        self, commands: Commands, points: PointSet, d_encoding: DeviceArray, d_tables: list[DeviceArray]
    ) -> None:
        """Add the gradient of the tables, from that of the encoding, whose rows must hold nothing else."""
        number, n = points.number, points.count
        targets, sums = [], []
        for part in self._parts:
            target = d_tables[part.grid]
            if part.sliced:
                target = self.pool.array(f"d_slices {part.grid}", (part.entries, 2))
                commands.clear(target)
            targets.append(target)
            if not self.lane_levels:
                target = self.pool.array(f"d_fixed {part.grid} {part.sliced}", (2 * target.size,), "uint32")
                commands.clear(target)
            sums.append(target)

        options = _precision(d_encoding)
        largest = {} if self.lane_levels else {"largest": self._largest(commands, points, d_encoding, options)}
        options |= {"LANE_LEVELS": 1} if self.lane_levels else {}
        for first, count in self._blocks(n, d_encoding, self._most_points):
            for part, target in zip(self._parts, sums, strict=True):
                kernel = Kernel.get(self.device, "hashgrid_bwd", **self._defines(part), **options)
                groups = -(-part.count // 8) if self.lane_levels else -(-count // 64) * part.count
                arrays = {"points": points.array.rows(first, count), "d_encoding": d_encoding.rows(first, count)}
                arrays |= {"levels": part.levels, "d_features": target, "d_fixed": target, **largest}
                arrays["grid"] = self._uniform(part, f"{number} from {first}", count, n, points.time)
                commands.run(kernel, groups, arrays)

        for part, target, fixed in zip(self._parts, targets, sums, strict=True):
            uniform = self._uniform(part, f"{number}", n, n, points.time)
            if not self.lane_levels:
                unfix = Kernel.get(self.device, "hashgrid_unfix", **self._defines(part))
                commands.dispatch(
                    unfix, -(-target.size // 64), grid=uniform, d_fixed=fixed, d_features=target, **largest
                )
            if part.sliced:
                kernel = Kernel.get(self.device, "hashgrid_slice_bwd", **self._defines(part))
                arrays = {"levels": part.levels, "d_slices": target, "d_features": d_tables[part.grid]}
                commands.dispatch_grid(kernel, (-(-part.cells // 64), part.count), grid=uniform, **arrays)

    def _largest(
        self, commands: Commands, points: PointSet, d_encoding: DeviceArray, options: dict[str, int]
    ) -> DeviceArray:
        """The largest absolute value of a gradient, which scales fixed-point sums."""
        number, n = points.number, points.count
        largest = self.pool.array(f"largest {number}", (1,), "uint32")
        commands.clear(largest)
        kernel = Kernel.get(self.device, "hashgrid_largest", CORNERS=4, **options)
        for first, count in self._blocks(n, d_encoding):
            grid = self._uniform(self._parts[0], f"{number} largest from {first}", count, n, points.time)
            gradient = d_encoding.rows(first, count)
            commands.dispatch(kernel, -(-count * self._row // 4096), grid=grid, d_encoding=gradient, largest=largest)
        return largest


def _precision(encoding: DeviceArray) -> dict[str, int]:
    return {"BFLOAT16": 1} if encoding.dtype == "int16" else {}
