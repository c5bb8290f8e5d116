"""Configuration of the raster kernels for a device: tile size, and the pixels of each lane."""

import functools
from dataclasses import dataclass, replace

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import SOFTWARE_LOOP_TURNS, Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel

# Per band, on devices that limit loops: loops over the tiles of a splat take one iteration per tile, and a splat may
# cover all. Below SOFTWARE_LOOP_TURNS and the workgroups of one dimension.
MAX_BAND_TILES = 60_000

# At least the turns of loops for each splat of a round. Without subgroups the backward pass sums a splat's ten values
# in loops over the lanes: 20 turns.
SUBGROUP_TURNS, PLAIN_TURNS = 2, 32

_PROBED_LANES = 64  # probe_subgroup.wgsl: as many as the raster passes have at most


@dataclass(frozen=True)
class RasterConfig:
    """A workgroup of `lanes` draws a tile of tile_width x tile_height pixels, each lane `rows` pixels of a column.

    subgroups: the lanes form one subgroup and exchange values by shuffles instead of workgroup memory.
    lane_runs: use the radix sort for CPU devices, and a polynomial for exp2, which is slow there.
    round_splats: maximum number of splats of a list that one dispatch draws, on devices that limit loops; else None.
    """

    tile_width: int
    tile_height: int
    lanes: int
    subgroups: bool
    lane_runs: bool
    round_splats: int | None = None

    @property
    def tile_defines(self) -> dict[str, int]:
        return {"TILE_W": self.tile_width, "TILE_H": self.tile_height}

    def without_subgroups(self) -> "RasterConfig":
        """Return the same for a driver that splits workgroups: with longer loops, and therefore shorter rounds."""
        rounds = self.round_splats and self.round_splats * SUBGROUP_TURNS // PLAIN_TURNS
        return replace(self, subgroups=False, round_splats=rounds)

    def raster_defines(self, *, depth: bool) -> dict[str, int]:
        """Return the defines of the passes rasterize and rasterize_bwd. depth: whether to draw it, too."""
        flags = {"SUBGROUPS": self.subgroups, "DEPTH": depth, "LANES_16": self.lanes > 8, "LANES_32": self.lanes > 16}
        values = {"LANES": self.lanes, "ROWS": self.tile_width * self.tile_height // self.lanes}
        values |= {"POLYNOMIAL_EXP2": self.lane_runs, "ROUND_SPLATS": self.round_splats or False}
        return self.tile_defines | values | flags


def cpu_config(subgroup_size: int) -> RasterConfig:
    """Return the configuration for processors: a workgroup is one vector of the processor, so that no barrier waits."""
    lanes = 16 if subgroup_size == 16 else 8
    subgroups = subgroup_size >= lanes
    round_splats = (SOFTWARE_LOOP_TURNS + 1) // (SUBGROUP_TURNS if subgroups else PLAIN_TURNS)
    return RasterConfig(8, 8, lanes, subgroups, lane_runs=True, round_splats=round_splats)


def gpu_config(subgroup_size: int) -> RasterConfig:
    """Return the configuration for GPUs: wider tiles, hence fewer intersections to sort; a subgroup per tile."""
    lanes = 16 if subgroup_size == 16 else 32
    return RasterConfig(16, 8, lanes, subgroups=subgroup_size >= lanes, lane_runs=False)


@functools.cache
def subgroup_size(device: Device) -> int:
    """Return the lanes of a subgroup, 0 without subgroups, as a kernel measures them: adapters are unreliable there."""
    if "subgroup" not in device.features:
        return 0
    sizes = DeviceArray.empty(device, "subgroup sizes", (_PROBED_LANES,), "uint32")
    with Commands(device) as commands:
        commands.dispatch(Kernel.get(device, "probe_subgroup"), 1, sizes=sizes)
    found = set(sizes.read().tolist())
    return found.pop() if len(found) == 1 else 0


def raster_config(device: Device) -> RasterConfig:
    """Return the configuration for this adapter."""
    size = subgroup_size(device)
    return cpu_config(size) if device.is_cpu else gpu_config(size)
