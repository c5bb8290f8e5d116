"""What the passes of rasterizer and hash encoder have to do at least, counted from the scene: bytes, operations, powers
of two.

Bytes are those that a pass asks for: what each Gaussian, visible splat, intersection, pixel or tile makes it load and
store, whether it lies in a cache or not. An operation is what a lane does in one instruction: add, multiply, both at
once, compare, choose, shuffle, divide. They were counted in the shaders' source; loops and addresses are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.radix_sort import FEW_BLOCKS, FEW_RUNS, runs
from lapgs_wgpu.motion.fields.config import GridShape
from lapgs_wgpu.splat.drawing import Drawing
from lapgs_wgpu.splat.rasterizer import Rasterizer

SPLAT = 48  # bytes; common/splat.wgsl
RECORD = 36  # bytes of an intersection's gradient, without depth
BATCH_BYTES = SPLAT + 8  # an intersection's slot, its splat's number, the splat


@dataclass(frozen=True)
class Work:
    bytes: float
    operations: float = 0.0
    exponentials: float = 0.0

    def __mul__(self, times: int) -> "Work":
        return Work(times * self.bytes, times * self.operations, times * self.exponentials)


@dataclass(frozen=True)
class SceneCounts:
    """Of an image, added up over the bands in which it is drawn.

    visible: splats with a tile. intersections: pairs of splat and tile. drawn: those before their tile was full.
    pairs: of drawn intersections and the pixels of their tiles. filled: pixels of tiles with splats.
    """

    gaussians: int
    visible: int
    intersections: int
    drawn: int
    pairs: int
    tiles: int
    filled: int
    pixels: int
    bands: int


def count_scene(rasterizer: Rasterizer, drawing: Drawing) -> SceneCounts:
    """Of the image that was drawn last, whose bands are drawn once more."""
    config, camera = rasterizer.config, drawing.camera
    visible = intersections = drawn = tiles = filled = 0
    for band in range(drawing.plan.bands):
        with Commands(rasterizer.device) as commands:
            rasterizer._draw_band(commands, drawing, band)
        here = rasterizer._band_tiles(drawing, band)
        arrays = drawing.arrays
        seen, needed, ranges = read_all([arrays["visible"], drawing.needed[band], arrays["ranges"].rows(0, here)])
        visible, intersections, tiles = visible + int(seen[0]), intersections + int(needed[0]), tiles + here
        listed = ranges[ranges[:, 1] > 0]
        drawn += int((listed[:, 2] - listed[:, 0]).sum())
        filled += len(listed)
    area, pixels = config.tile_width * config.tile_height, camera.width * camera.height
    return SceneCounts(
        gaussians=len(drawing.gaussians),
        visible=visible,
        intersections=intersections,
        drawn=drawn,
        pairs=drawn * area,
        tiles=tiles,
        filled=min(filled * area, pixels),
        pixels=pixels,
        bands=drawing.plan.bands,
    )


def raster_work(scene: SceneCounts, rasterizer: Rasterizer) -> dict[str, Work]:
    """Shader -> all its dispatches in a forward and backward pass, for given colors, without depth."""
    n, v, i = scene.gaussians * scene.bands, scene.visible, scene.intersections
    lanes = scene.drawn * rasterizer.config.lanes  # a lane does this much for its column of each drawn splat
    rows = sqrt(v * i)  # of tiles, over all splats, as if each touched as many rows as columns
    depth, tile = (
        _sort_counters(rasterizer, capacity, bits)
        for capacity, bits in (
            (scene.gaussians, 32),
            (rasterizer.plans.now.capacity, (scene.tiles // scene.bands).bit_length()),
        )
    )
    keys = depth.passes * v + tile.passes * i
    counters = scene.bands * (depth.passes * depth.counters + tile.passes * tile.counters)
    scanned = scene.bands * sum(sort.passes * sort.counters for sort in (depth, tile) if sort.scanned)
    places = scene.bands * sum(sort.passes * sort.counters * sort.readers for sort in (depth, tile))
    written = scene.pixels
    draw = {
        "project": Work(44 * n + 52 * n + 52 * v, 20 * n + 145 * v + 55 * rows),
        "color": Work(4 * n + 24 * v),
        "scan_reduce": Work(4 * n + 8 * v + 4 * scanned, n + v + scanned),
        "scan_apply": Work(12 * n + 20 * v + 12 * scanned, 2 * (n + v + scanned)),
        "compact": Work(4 * n + 28 * v),
        "sort_count": Work(4 * keys + 4 * counters, 4 * keys),
        "sort_scatter": Work(16 * keys - 4 * i + 4 * places, 5 * keys),  # the first tile digit has no payload to read
        "duplicate_with_keys": Work((12 + SPLAT) * v + 8 * i, 20 * v + 55 * rows + 3 * i),
        "tile_ranges": Work(6 * i + 16 * scene.tiles, 6 * i),
        "rasterize": Work(
            BATCH_BYTES * scene.drawn + 16 * written + 20 * scene.tiles, 16 * scene.pairs + 14 * lanes, scene.pairs
        ),
    }
    backward = {
        "rasterize_bwd": Work(
            (BATCH_BYTES + RECORD) * scene.drawn + (4 + RECORD) * (i - scene.drawn) + 32 * scene.filled,
            32 * scene.pairs + 54 * lanes,
            scene.pairs,
        ),
        "gather_gradients": Work((12 + 32 + 2 * SPLAT) * v + RECORD * i, 9 * i + 20 * v, v),
        "project_bwd": Work(56 * scene.gaussians + (32 + 40) * v, 290 * v),
    }
    drawings = 1 if scene.bands == 1 else 2  # the backward pass draws each band again
    return {name: work * drawings for name, work in draw.items()} | backward


@dataclass(frozen=True)
class _Sort:
    """counters: of a pass. scanned: whether a scan adds them up, or each of `readers` workgroups."""

    passes: int
    counters: int
    scanned: bool = True
    readers: int = 1


def _sort_counters(rasterizer: Rasterizer, capacity: int, bits: int) -> _Sort:
    """As gpu/radix_sort divides the keys."""
    bits = max(1, bits)
    if rasterizer.config.lane_runs:
        passes = -(-bits // 8)
        owners = runs(capacity)
        scanned = owners > FEW_RUNS
        return _Sort(passes, (1 << -(-bits // passes)) * owners, scanned, 1 if scanned else owners // 8)
    owners = -(-capacity // 2048)
    scanned = owners > FEW_BLOCKS
    return _Sort(-(-bits // 4), 16 * owners, scanned, 1 if scanned else owners)


def encoder_work(grids: Sequence[GridShape], points: int, *, lane_levels: bool) -> dict[str, Work]:
    """Shader -> all its dispatches in an encoding of the points with all grids, and its backward pass."""
    sliced = [grid.levels[k] for grid in grids for k in grid.sliced]
    direct = sum(len(grid.levels) for grid in grids) - len(sliced)
    cells = sum(level.resolution[0] * level.resolution[1] for level in sliced)
    of_sliced, of_direct = points * len(sliced), points * direct
    operations = 78 * of_sliced + 222 * of_direct
    corners = 4 * of_sliced + 8 * of_direct
    work = {
        "hashgrid_slice": Work(24 * cells, 6 * cells),
        "hashgrid": Work(24 * (of_sliced + of_direct) + 8 * corners, operations),
        # An entry of two features is read and written, in fixed point as four words.
        "hashgrid_bwd": Work(24 * (of_sliced + of_direct) + (16 if lane_levels else 32) * corners, operations),
        "hashgrid_slice_bwd": Work(40 * cells, 6 * cells),
    }
    if not lane_levels:
        work["hashgrid_unfix"] = Work(32 * (cells + sum(grid.entries for grid in grids)))
    return work
