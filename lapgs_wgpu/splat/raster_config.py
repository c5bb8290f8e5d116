"""The shape of the raster kernels on a device: which tile a workgroup draws, and how its lanes share the pixels."""

from __future__ import annotations

from dataclasses import dataclass

from ..gpu.device import SOFTWARE_LOOP_TURNS, Device
from ..gpu.probe_subgroup import subgroup_size

# Of an image, or a band of one, where the device limits loops: a splat that covers it all is counted, listed and summed
# up a turn a tile. Below every device's `max_loop_turns`.
MAX_BAND_TILES = 60_000


@dataclass(frozen=True)
class RasterConfig:
    """A workgroup of `lanes` draws a tile of tile_width x tile_height pixels, each lane `rows` pixels of one column.

    subgroups: the lanes lie in one subgroup and exchange values by shuffles instead of workgroup memory.
    lane_runs: the radix sort's shape for CPU devices, which also have no fast exp2.
    round_splats: most splats of a tile's list that a dispatch draws, where the driver ends long loops; else None.
    long_list: length from which on a list is drawn in several rounds in any case, there. All its slots then have no
    record beforehand, and the backward pass need not turn to say so of the splats that nobody sees.
    """

    tile_width: int
    tile_height: int
    lanes: int
    subgroups: bool
    lane_runs: bool
    round_splats: int | None = None
    long_list: int = 1 << 16

    @property
    def rows(self) -> int:
        return self.tile_width * self.tile_height // self.lanes

    @property
    def tile_defines(self) -> dict[str, int]:
        return {"TILE_W": self.tile_width, "TILE_H": self.tile_height}

    def raster_defines(self, *, depth: bool) -> dict[str, int]:
        """Defines of rasterize and rasterize_bwd."""
        flags = {"SUBGROUPS": self.subgroups, "DEPTH": depth, "LANES_16": self.lanes > 8, "LANES_32": self.lanes > 16}
        values = {"LANES": self.lanes, "ROWS": self.rows, "POLYNOMIAL_EXP2": self.lane_runs}
        if self.round_splats:
            values |= {"ROUND_SPLATS": self.round_splats, "LONG_LIST": self.long_list}
        return self.tile_defines | values | flags


def cpu_config(subgroup_size: int, max_loop_turns: int = SOFTWARE_LOOP_TURNS) -> RasterConfig:
    """A workgroup is one vector of the processor, so that nothing has to wait at barriers."""
    lanes = 16 if subgroup_size == 16 else 8
    subgroups = subgroup_size >= lanes
    # Without subgroups the backward pass adds up a splat's ten values by loops over the lanes, 20 turns a splat.
    round_splats = (max_loop_turns + 1) // (2 if subgroups else 32)
    return RasterConfig(8, 8, lanes, subgroups, True, round_splats, long_list=max_loop_turns + 1)


def gpu_config(subgroup_size: int) -> RasterConfig:
    """Wider tiles, hence fewer intersections to sort, and a subgroup of 16 or 32 lanes a tile."""
    lanes = 16 if subgroup_size == 16 else 32
    return RasterConfig(16, 8, lanes, subgroups=subgroup_size >= lanes, lane_runs=False)


def raster_config(device: Device) -> RasterConfig:
    """The configuration for this adapter."""
    size = subgroup_size(device)
    return gpu_config(size) if device.max_loop_turns is None else cpu_config(size, device.max_loop_turns)
