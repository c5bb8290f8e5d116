"""The shape of the raster kernels on a device: which tile a workgroup draws, and how its lanes share the pixels."""

from __future__ import annotations

from dataclasses import dataclass

from ..gpu.device import Device


@dataclass(frozen=True)
class RasterShape:
    """A workgroup of `lanes` draws a tile of tile_width x tile_height pixels, each lane `rows` pixels of one column.

    subgroups: the lanes lie in one subgroup and exchange values by shuffles instead of workgroup memory.
    lane_runs: the radix sort's shape for CPU devices, which also have no fast exp2.
    """

    tile_width: int
    tile_height: int
    lanes: int
    subgroups: bool
    lane_runs: bool

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
        return values | {name: 1 for name, on in flags.items() if on}


def cpu_shape(subgroup_size: int) -> RasterShape:
    """A workgroup is one vector of the processor, so that nothing has to wait at barriers."""
    lanes = 16 if subgroup_size == 16 else 8
    return RasterShape(8, 8, lanes, subgroups=subgroup_size >= lanes, lane_runs=True)


def gpu_shape(subgroup_size: int) -> RasterShape:
    """Wider tiles, hence fewer intersections to sort, and a subgroup of 16 or 32 lanes a tile."""
    lanes = 16 if subgroup_size == 16 else 32
    return RasterShape(16, 8, lanes, subgroups=subgroup_size >= lanes, lane_runs=False)


def raster_shape(device: Device) -> RasterShape:
    """The shape for this adapter."""
    return (cpu_shape if device.is_cpu else gpu_shape)(device.subgroup_size)
