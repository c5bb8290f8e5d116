"""Shapes of multi-resolution hash grids (Instant-NGP, with the resolutions of Grid4D; paper eq. 1). Without torch."""

import math
from dataclasses import dataclass

from lapgs_wgpu.io.dataclass_table import Options, option

_SLICE_CELLS = 1 << 14  # a level with more cells per plane is not sliced
TIME = 3  # the axis number of time


@dataclass(frozen=True)
class HashConfig(Options):
    """The shape of a grid."""

    levels: int = option(
        "number of resolution levels, which grow geometrically from base to finest", 16, at_least=1, at_most=64
    )
    base: tuple[int, int, int] = option(
        "resolution of the coarsest level along each axis", (16, 16, 16), at_least=2, at_most=1 << 16
    )
    finest: tuple[int, int, int] = option(
        "resolution of the finest level along each axis", (2048, 2048, 2048), at_least=2, at_most=1 << 16
    )
    table_log2: int = option(
        "log2 of the largest number of entries per level; larger levels are hashed", 19, at_least=1, at_most=24
    )


@dataclass(frozen=True)
class Level:
    """A level. scale: cells along each axis, a real number. resolution: entries along each axis. first: first entry."""

    scale: tuple[float, float, float]
    resolution: tuple[int, int, int]
    entries: int
    first: int

    @property
    def dense(self) -> bool:
        return math.prod(self.resolution) <= self.entries


def make_levels(config: HashConfig) -> list[Level]:
    """Return the levels of a grid, whose resolution grows geometrically along each axis."""
    levels, first = [], 0
    for number in range(config.levels):
        share = number / max(1, config.levels - 1)
        x, y, z = (a * (b / a) ** share for a, b in zip(config.base, config.finest, strict=True))
        resolution = math.ceil(x - 1e-9), math.ceil(y - 1e-9), math.ceil(z - 1e-9)
        entries = min(1 << config.table_log2, math.prod(resolution))
        levels.append(Level((x - 1, y - 1, z - 1), resolution, entries, first))
        first += entries
    return levels


class GridShape:
    """A grid without its table. axes: three of x, y, z (0 to 2) and t (3, only as the last one)."""

    def __init__(self, config: HashConfig, axes: tuple[int, int, int]) -> None:
        self.axes = axes
        self.levels = make_levels(config)

    @property
    def entries(self) -> int:
        """Number of rows of the table, which hold two features each."""
        return self.levels[-1].first + self.levels[-1].entries

    @property
    def features(self) -> int:
        """Length of a point's encoding."""
        return 2 * len(self.levels)

    @property
    def sliced(self) -> list[int]:
        """Levels that are sliced at the time of the points before the lookup."""
        if self.axes[2] != TIME:
            return []
        cells = [level.resolution[0] * level.resolution[1] for level in self.levels]
        return [i for i, level in enumerate(self.levels) if level.dense and cells[i] <= _SLICE_CELLS]
