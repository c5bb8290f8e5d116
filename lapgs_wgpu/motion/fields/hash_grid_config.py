"""Shapes of multi-resolution hash grids (Instant-NGP's, with the resolutions of Grid4D; paper eq. 1), without torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

_SLICE_CELLS = 1 << 14  # a level with more cells a plane than this is looked up directly, not cut
TIME = 3  # the axis number of time


def option(default: Any, help_text: str) -> Any:
    """A field of a configuration, with the help that lapgs-train --help shows."""
    return field(default=default, metadata={"help": help_text})


@dataclass(frozen=True)
class HashConfig:
    """The shape of a grid."""

    levels: int = option(16, "number of resolution levels")
    base: tuple[int, int, int] = option((16, 16, 16), "resolution of the coarsest level along each axis")
    finest: tuple[int, int, int] = option((2048, 2048, 2048), "resolution of the finest level along each axis")
    table_log2: int = option(19, "log2 of the largest number of entries per level; larger levels are hashed")

    def __post_init__(self) -> None:
        if not (1 <= self.levels <= 64 and 1 <= self.table_log2 <= 24):
            raise ValueError(f"levels must be 1 to 64 and table_log2 1 to 24, got {self.levels} and {self.table_log2}")
        for size in (*self.base, *self.finest):
            if not 2 <= size <= 1 << 16:
                raise ValueError(f"base and finest must be 2 to {1 << 16} entries, got {size}")


@dataclass(frozen=True)
class Level:
    """scale: cells along each axis, a real number; resolution: entries along each axis; first: its first entry."""

    scale: tuple[float, float, float]
    resolution: tuple[int, int, int]
    entries: int
    first: int

    @property
    def dense(self) -> bool:
        return math.prod(self.resolution) <= self.entries


def make_levels(config: HashConfig) -> list[Level]:
    """The levels of a grid: the resolution grows geometrically along each axis."""
    levels, first = [], 0
    for number in range(config.levels):
        share = number / max(1, config.levels - 1)
        exact = [a * (b / a) ** share for a, b in zip(config.base, config.finest, strict=True)]
        resolution = [math.ceil(size - 1e-9) for size in exact]
        entries = min(1 << config.table_log2, math.prod(resolution))
        x, y, z = exact
        levels.append(Level((x - 1, y - 1, z - 1), (resolution[0], resolution[1], resolution[2]), entries, first))
        first += entries
    return levels


class GridShape:
    """A grid without its table: over three of the axes x, y, z (0 to 2) and t (3, only as the last)."""

    def __init__(self, config: HashConfig, axes: tuple[int, int, int]) -> None:
        self.axes = axes
        self.levels = make_levels(config)

    @property
    def entries(self) -> int:
        """Rows of the table, of two features each."""
        return self.levels[-1].first + self.levels[-1].entries

    @property
    def features(self) -> int:
        """Length of a point's encoding."""
        return 2 * len(self.levels)

    @property
    def sliced(self) -> list[int]:
        """The levels that are cut at the time of the step."""
        if self.axes[2] != TIME:
            return []
        cells = [level.resolution[0] * level.resolution[1] for level in self.levels]
        return [i for i, level in enumerate(self.levels) if level.dense and cells[i] <= _SLICE_CELLS]
