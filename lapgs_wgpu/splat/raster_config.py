"""The shape of the raster kernels on a device: which tile a workgroup draws, and how its lanes share the pixels."""

from __future__ import annotations

from dataclasses import dataclass

from ..gpu.device import Device

# Mesa's software driver ends a shader without a word when all loops of an invocation together have turned 65,535 times.
# A longer list is drawn in several rounds in any case: all its slots then have no record beforehand, and the backward
# pass need not turn to say so of the splats that nobody sees.
LONG_LIST = 1 << 16
# Of an image, or a band of one: a splat that covers it all is counted, listed and summed up a turn a tile.
MOST_TILES = 60_000


@dataclass(frozen=True)
class RasterConfig:
    """A workgroup of `lanes` draws a tile of tile_width x tile_height pixels, each lane `rows` pixels of one column.

    subgroups: the lanes lie in one subgroup and exchange values by shuffles instead of workgroup memory.
    lane_runs: the radix sort's shape for CPU devices, which also have no fast exp2.
    round_splats: most splats of a tile's list that a dispatch draws, where the driver ends long loops; else None.
    """

    tile_width: int
    tile_height: int
    lanes: int
    subgroups: bool
    lane_runs: bool
    round_splats: int | None = None

    @property
    def rows(self) -> int:
        return self.tile_width * self.tile_height // self.lanes

    @property
    def tile_defines(self) -> dict[str, int]:
        return {"TILE_W": self.tile_width, "TILE_H": self.tile_height}

    def raster_defines(self, *, depth: bool) -> dict[str, int]:
        """Defines of rasterize and rasterize_bwd."""
        flags = {"SUBGROUPS": self.subgroups, "DEPTH": depth, "LANES_16": self.lanes > 8, "LANES_32": self.lanes > 16}
        flags["POLYNOMIAL_EXP2"] = self.lane_runs
        values = self.tile_defines | {"LANES": self.lanes, "ROWS": self.rows}
        if self.round_splats:
            values |= {"ROUND_SPLATS": self.round_splats, "LONG_LIST": LONG_LIST}
        return values | {name: 1 for name, on in flags.items() if on}


def cpu_config(subgroup_size: int) -> RasterConfig:
    """A workgroup is one vector of the processor, so that nothing has to wait at barriers."""
    lanes = 16 if subgroup_size == 16 else 8
    subgroups = subgroup_size >= lanes
    # Without subgroups the backward pass adds up a splat's ten values by loops over the lanes, 20 turns a splat.
    return RasterConfig(8, 8, lanes, subgroups, lane_runs=True, round_splats=1 << 15 if subgroups else 1 << 11)


def gpu_config(subgroup_size: int) -> RasterConfig:
    """Wider tiles, hence fewer intersections to sort, and a subgroup of 16 or 32 lanes a tile."""
    lanes = 16 if subgroup_size == 16 else 32
    return RasterConfig(16, 8, lanes, subgroups=subgroup_size >= lanes, lane_runs=False)


def raster_config(device: Device) -> RasterConfig:
    """The shape for this adapter."""
    return (cpu_config if device.is_cpu else gpu_config)(device.subgroup_size)
