"""Device passes of the hash encoder, without torch: lookup of points in several hash grids, and gradients of tables.

All points share one time. Levels of a grid with a time axis are first sliced at that time, if that is cheaper than
looking up two planes for each point.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import SOFTWARE_LOOP_TURNS, Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.motion.fields.config import GridShape

_ALIGNED = 64  # rows; a multiple of 256 bytes for every row size, at which a binding may begin
_LEVEL_WORDS = 16  # common/hashgrid.wgsl: struct Level


@dataclass(frozen=True)
class PointSet:
    """Points at one time.

    number: distinguishes the sets that are submitted together. array: (N, 4) world units. count: number of points to
    encode. time: gives the one in [0, 1].
    """

    number: int
    array: DeviceArray
    count: int
    time: Callable[[], float]


@dataclass(frozen=True)
class _Levels:
    """Levels that one dispatch takes. cells: of the largest level's plane."""

    defines: dict[str, int]
    count: int
    cells: int
    array: DeviceArray


class HashEncoderPasses:
    """Records the passes that encode points with several grids. Axes and levels are fixed.

    On CPU devices, a lane owns a level in the backward pass and takes many points or cells in the others; on GPUs it
    owns few, with fixed-point atomics.
    first_table: number of the first grid's table among those that are given with each call.
    row, column: the encoding's rows have `row` floats; the grids' features are written one after another from `column`
    on. Both are even. By default the rows hold the features only.
    """

    def __init__(
        self,
        device: Device,
        grids: Sequence[GridShape],
        bound: float,
        *,
        first_table: int = 0,
        row: int | None = None,
        column: int = 0,
    ) -> None:
        self.features = sum(grid.features for grid in grids)
        self._device, self._bound, self._pool = device, bound, BufferPool(device)
        self._lane_levels = device.is_cpu
        self._group_points, self._group_cells = (2048, 1024) if self._lane_levels else (512, 64)
        self._row = self.features if row is None else row
        self._cuts: dict[int, _Levels] = {}  # by table: the levels that are sliced
        self._direct: dict[int, _Levels] = {}  # by table: the others
        self._slices: _Levels | None = None  # those that are sliced, of all grids
        self._slice_entries = 0
        of_slices: list[NDArray[np.uint32]] = []
        for number, grid in enumerate(grids, first_table):
            words = _level_words(grid, column // 2, self._slice_entries)
            sliced = np.isin(np.arange(len(words)), grid.sliced)
            if sliced.any():
                self._cuts[number] = self._levels(words[sliced], sliced=True)
                of_slices.append(words[sliced])
            if not sliced.all():
                self._direct[number] = self._levels(words[~sliced], sliced=False)
            self._slice_entries += int(words[sliced, 4:6].prod(axis=1).sum())
            column += grid.features
        if of_slices:
            self._slices = self._levels(np.concatenate(of_slices), sliced=True)

    def _levels(self, words: NDArray[np.uint32], *, sliced: bool) -> _Levels:
        array = DeviceArray.upload(self._device, "levels", words)
        defines = {"SLICED": 1, "CORNERS": 4} if sliced else {"CORNERS": 8}
        return _Levels(defines, len(words), int(words[:, 4:6].prod(axis=1).max()), array)

    def _lookups(self, slices: DeviceArray, tables: Sequence[DeviceArray]) -> list[tuple[_Levels, DeviceArray]]:
        """Return the levels of each lookup, with what they are looked up in, or with its gradient."""
        direct = [(levels, tables[number]) for number, levels in self._direct.items()]
        return direct if self._slices is None else [(self._slices, slices), *direct]

    def _uniform(self, points: PointSet, first: int, count: int) -> DeviceArray:
        """Return the uniform of a block; each has its own, since all blocks of all sets are submitted together."""
        kernel = Kernel.get(self._device, "hashgrid_slice")
        sizes = {"points": count, "all_points": points.count, "all_levels": self._row // 2, "bound": self._bound}
        name = f"grid {points.number} from {first}"
        return self._pool.varying(name, lambda: kernel.uniform("Grid", time=points.time(), **sizes))

    def _blocks(self, points: PointSet) -> list[tuple[int, int, DeviceArray]]:
        """Return first point, number of points and uniform of each dispatch: as many as fit in a binding, and where a
        lane loops over all of them, at most half of the iterations that the driver allows."""
        size = self._device.max_binding // max(4 * self._row, 1) // _ALIGNED * _ALIGNED
        if self._lane_levels:
            size = min(size, (SOFTWARE_LOOP_TURNS + 1) // 2)
        counts = [(first, min(size, points.count - first)) for first in range(0, points.count, size)]
        return [(first, count, self._uniform(points, first, count)) for first, count in counts]

    def encode(self, commands: Commands, points: PointSet, tables: list[DeviceArray], encoding: DeviceArray) -> None:
        """Encode points; outside the box [-bound, bound]^3 features are zero.

        tables: (entries, 2) of each grid. encoding: (N, row) float32, N = points.count.
        """
        blocks = self._blocks(points)
        slices = self._pool.array("slices", (self._slice_entries, 2))
        for number, cut in self._cuts.items() if blocks else ():
            kernel = Kernel.get(self._device, "hashgrid_slice", LONG_LANES=self._lane_levels)
            arrays = {"levels": cut.array, "features": tables[number], "slices": slices, "grid": blocks[0][2]}
            commands.dispatch_grid(kernel, (-(-cut.cells // self._group_cells), cut.count), **arrays)
        for first, count, grid in blocks:
            arrays = {"points": points.array.rows(first, count), "encoding": encoding.rows(first, count), "grid": grid}
            for levels, features in self._lookups(slices, tables):
                kernel = Kernel.get(self._device, "hashgrid", **levels.defines, LONG_LANES=self._lane_levels)
                groups = -(-count // self._group_points) * levels.count
                commands.dispatch(kernel, groups, levels=levels.array, features=features, **arrays)

    def add_gradient(
        self, commands: Commands, points: PointSet, d_encoding: DeviceArray, d_tables: list[DeviceArray]
    ) -> None:
        """Add the gradient of the tables, from that of the encoding, whose rows must hold nothing else."""
        if not points.count:
            return
        d_slices, blocks = self._pool.array("d_slices", (self._slice_entries, 2)), self._blocks(points)
        cores = os.cpu_count() or 1
        commands.clear(d_slices)
        sums = floats = self._lookups(d_slices, d_tables)
        of_all: dict[str, DeviceArray] = {"grid": blocks[0][2]}
        if not self._lane_levels:
            named = enumerate(floats)
            sums = [(of, self._pool.array(f"d_fixed {i}", (2 * d.size,), "uint32")) for i, (of, d) in named]
            largest = of_all["largest"] = self._pool.array(f"largest {points.number}", (1,), "uint32")
            commands.clear(largest)
            for first, count, grid in blocks:  # the largest absolute value, which scales fixed-point sums
                arrays = {"grid": grid, "d_encoding": d_encoding.rows(first, count), "largest": largest}
                kernel = Kernel.get(self._device, "hashgrid_largest")
                commands.dispatch(kernel, -(-count * self._row // 4096), **arrays)
        for first, count, grid in blocks:
            arrays = {"points": points.array.rows(first, count), "d_encoding": d_encoding.rows(first, count)}
            for levels, target in sums:
                kernel = Kernel.get(self._device, "hashgrid_bwd", **levels.defines, LANE_LEVELS=self._lane_levels)
                groups = -(-count // 64) * levels.count
                if self._lane_levels:  # as many for each core, with at most eight levels in each
                    groups = min(levels.count, -(-levels.count // (8 * cores)) * cores)
                arrays |= {"levels": levels.array, "d_features": target, "d_fixed": target}
                commands.run(kernel, groups, of_all | arrays | {"grid": grid})
                commands.flush()  # all lookups together may take longer than a watchdog allows
        if not self._lane_levels:
            unfix = Kernel.get(self._device, "hashgrid_unfix")
            for (_, target), (_, fixed) in zip(floats, sums, strict=True):
                commands.dispatch(unfix, -(-target.size // 64), d_fixed=fixed, d_features=target, **of_all)
        for number, cut in self._cuts.items():
            kernel = Kernel.get(self._device, "hashgrid_slice_bwd", LONG_LANES=self._lane_levels)
            arrays = {"levels": cut.array, "d_slices": d_slices, "d_features": d_tables[number], "grid": blocks[0][2]}
            commands.dispatch_grid(kernel, (-(-cut.cells // self._group_cells), cut.count), **arrays)


def _level_words(grid: GridShape, first_number: int, first_sliced: int) -> NDArray[np.uint32]:
    """Return a grid's levels (levels, 16) as common/hashgrid.wgsl reads them.

    first_number: of the grid's first level in a row of the encoding. first_sliced: the first free entry of the slices.
    """
    words = np.zeros((len(grid.levels), _LEVEL_WORDS), np.uint32)
    for i, (row, level) in enumerate(zip(words, grid.levels, strict=True)):
        row[:3] = np.asarray(level.scale, np.float32).view(np.uint32)
        row[3:8] = (level.dense, *level.resolution, level.entries)
        row[8:14] = (*grid.axes, first_number + i, level.first, first_sliced)
        if i in grid.sliced:
            first_sliced += level.resolution[0] * level.resolution[1]
    return words
