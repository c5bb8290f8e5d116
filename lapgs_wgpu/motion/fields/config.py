"""Configuration of deformation fields, and the shapes of their hash grids. Without torch."""

import math
from dataclasses import dataclass
from typing import Literal

from lapgs_wgpu.io.dataclass_table import Options, option
from lapgs_wgpu.splat.constants import CONSTANTS

Method = Literal["static", "mlp", "hexplane", "grid4d", "laplacian"]
FieldKind = Literal[Method, "own"]
MIN_SCALE = CONSTANTS["MIN_SCALE"]
TIME = 3  # the axis number of time
TEMPORAL_AXES = ((0, 1, TIME), (1, 2, TIME), (0, 2, TIME))  # of the temporal hash grids
GEOMETRY = (4, 3, 4, 3)  # outputs of the grid fields' geometry heads: turn, shift, quaternion, scale
_SLICE_CELLS = 1 << 14  # a level of a hash grid with more cells per plane is not sliced
_DEVICE_WIDTH = 2048  # largest width of a decoder that kernels evaluate
# Factor of the appearance head's outputs. The head then learns about as fast as the colors; faster, it would explain
# motion by changes of color.
APPEARANCE_SCALE = 0.1


@dataclass(frozen=True)
class HashConfig(Options):
    """The shape of a hash grid."""

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
class PlaneConfig(Options):
    """The planes of the field hexplane."""

    features: int = option("features per plane and level", 32, at_least=1, at_most=256)
    space: int = option("resolution of the coarsest planes along each spatial axis", 64, at_least=2, at_most=4096)
    time: int = option("resolution along the time axis", 75, at_least=2, at_most=4096)
    levels: int = option("levels; each doubles the spatial resolution of the one before", 2, at_least=1, at_most=6)


@dataclass(frozen=True)
class FieldConfig(Options):
    """The shape of a field."""

    kind: FieldKind = option(
        "deformation field, as for --field, but nothing else changes with it; own: a module given in Python",
        "laplacian",
    )
    bound: float = option("half side of its cube, world units; outside: a single motion", 1.6, above=0, below=1e6)
    unit: float = option(
        "how far an output of 1 moves a Gaussian, world units; more lets things learn to move and change size faster",
        1.0,
        above=0,
        below=1e6,
    )
    static: HashConfig = option("spatial hash grid (grid4d, laplacian)", HashConfig())
    temporal: HashConfig = option(
        "space-time hash grids, two axes and time (grid4d, laplacian)", HashConfig(32, (8, 8, 8), (32, 32, 16))
    )
    planes: PlaneConfig = option("feature planes of hexplane: xy, xz, yz, and each axis with time", PlaneConfig())
    width: int = option("width of the decoder's layers; of all layers of the field mlp", 256, at_least=1, at_most=4096)
    depth: int = option(
        "number of hidden layers between the decoder's first layers and its outputs (grid4d, laplacian, hexplane)",
        0,
        at_least=0,
        at_most=16,
    )
    time_scale: float = option(
        "share of the space-time grids' time axis for the clip, in its middle", 0.9, above=0, at_most=1
    )
    temporal_hash: bool = option("space-time hash grids (grid4d, laplacian); without, grid4d stands still", True)
    motion: Literal["laplacian", "mlp"] = option(
        "how laplacian decodes motion; laplacian: as a sum of sinusoids, the motion spectrum; mlp: from features and "
        "time",
        "laplacian",
    )
    components: int = option(
        "number of frequencies in the motion spectrum; fewer where the training times are too few to tell them apart",
        16,
        at_least=1,
        at_most=256,
    )
    frequency_step: float = option(
        "initial spacing of the spectrum's frequencies, which start at 0, cycles per clip", 1.0, above=0, below=1e6
    )
    amplitude: float = option(
        "initial standard deviation over time of the spectrum's sums of sinusoids; more: moves sooner, but may flicker",
        0.3,
        above=0,
        below=1e6,
    )
    dynamics: int = option(
        "length of each Gaussian's dynamics attribute, a learned motion code (laplacian, own); 0: none",
        16,
        at_least=0,
        at_most=256,
    )
    negative_scales: Literal["floor", "mirror"] = option(
        "what becomes of a Gaussian's size that motion makes negative; mirror: its magnitude counts (Grid4D); floor: "
        "1e-7 does",
        "floor",
    )
    appearance: Literal["none", "color", "color+opacity"] = option(
        "what laplacian changes over time besides geometry", "color"
    )

    @property
    def dynamics_size(self) -> int:
        """Length of a Gaussian's dynamics attribute; 0 for fields without it."""
        return self.dynamics if self.kind in ("laplacian", "own") else 0

    @property
    def appearance_size(self) -> int:
        """Number of outputs of the appearance head; 0 for fields without it."""
        return {"none": 0, "color": 3, "color+opacity": 4}[self.appearance] if self.kind == "laplacian" else 0

    @property
    def head_factors(self) -> list[float]:
        """Factors of the outputs of the grid fields' heads, geometry and appearance: lengths are learnt in `unit`."""
        turn, shift, quaternion, scale = GEOMETRY
        lengths = [*[1.0] * turn, *[self.unit] * shift, *[1.0] * quaternion, *[self.unit] * scale]
        return [*lengths, *[APPEARANCE_SCALE] * self.appearance_size]

    @property
    def decodes_on_device(self) -> bool:
        """Whether kernels for the field's decoder exist: for grid4d and laplacian without hidden layers, except for the
        ablation that replaces the spectrum by an MLP. In wider ones their loops exceed SOFTWARE_LOOP_TURNS."""
        kernels = self.kind == "grid4d" or (self.kind == "laplacian" and self.motion == "laplacian")
        return kernels and not self.depth and self.width <= _DEVICE_WIDTH

    def grid_time(self, t: float) -> float:
        """Return the position on the temporal grids' time axis, in [0, 1], of a time in [0, 1]."""
        return 0.5 * ((2.0 * t - 1.0) * self.time_scale + 1.0)


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


class GridShape:
    """A multi-resolution hash grid without its table (Instant-NGP, with the resolutions of Grid4D; paper eq. 1).

    axes: three of x, y, z (0 to 2) and t (3, only as the last one). entries: rows of the table, which hold two features
    each. features: length of a point's encoding.
    """

    def __init__(self, config: HashConfig, axes: tuple[int, int, int]) -> None:
        self.axes, self.features = axes, 2 * config.levels
        self.levels: list[Level] = []
        self.entries = 0
        for number in range(config.levels):  # the resolution grows geometrically along each axis
            share = number / max(1, config.levels - 1)
            x, y, z = (a * (b / a) ** share for a, b in zip(config.base, config.finest, strict=True))
            resolution = math.ceil(x - 1e-9), math.ceil(y - 1e-9), math.ceil(z - 1e-9)
            entries = min(1 << config.table_log2, math.prod(resolution))
            self.levels.append(Level((x - 1, y - 1, z - 1), resolution, entries, self.entries))
            self.entries += entries

    @property
    def sliced(self) -> list[int]:
        """Levels that are sliced at the time of the points before the lookup."""
        if self.axes[2] != TIME:
            return []
        cells = [level.resolution[0] * level.resolution[1] for level in self.levels]
        return [i for i, level in enumerate(self.levels) if level.dense and cells[i] <= _SLICE_CELLS]


def static_grid(config: FieldConfig) -> GridShape:
    """Return the spatial hash grid of the grid fields."""
    return GridShape(config.static, (0, 1, 2))


def temporal_grids(config: FieldConfig) -> list[GridShape]:
    """Return the space-time hash grids of the grid fields."""
    return [GridShape(config.temporal, axes) for axes in (TEMPORAL_AXES if config.temporal_hash else ())]
