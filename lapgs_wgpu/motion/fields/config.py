"""The configuration of a deformation field, and the sizes that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ...splat.constants import CONSTANTS
from .hash_grid_config import TIME, GridShape, HashConfig, option

FieldKind = Literal["static", "mlp", "hexplane", "grid4d", "laplacian"]
Motion = Literal["laplacian", "mlp"]
Appearance = Literal["none", "color", "color+opacity"]
DynamicsMode = Literal[
    "literal", "promote", "off"
]  # of the regularisation of the dynamics attribute (motion/fields/dynamics)
MIN_SCALE = CONSTANTS["MIN_SCALE"]
PLANES = ((0, 1), (0, 2), (1, 2), (0, TIME), (1, TIME), (2, TIME))  # of the field hexplane: pairs of x, y, z, t
TEMPORAL_AXES = ((0, 1, TIME), (1, 2, TIME), (0, 2, TIME))  # of the temporal hash grids
GEOMETRY = (4, 3, 4, 3)  # outputs of the grid fields' geometry heads: turn, shift, quaternion, scale
HEXPLANE_HEADS = (3, 4, 3)  # outputs of the field hexplane's heads: shift, quaternion, scale
# Of the field mlp: octaves of its inputs; features of the time; layers, before the one of which the inputs come in once
# more; outputs: shift, quaternion, scale.
PLACE_OCTAVES, TIME_OCTAVES, TIME_FEATURES, MLP_LAYERS, MLP_SKIP, MLP_OUTPUTS = 10, 6, 30, 8, 4, (3, 4, 3)
# Times the appearance head's outputs: it then learns about as fast as the colours themselves; at full speed it explains
# what is motion by changes of colour.
APPEARANCE_SCALE = 0.1
MAX_WIDTH, MAX_DEPTH, MAX_COMPONENTS, MAX_DYNAMICS = 4096, 16, 256, 256


@dataclass(frozen=True)
class PlaneConfig:
    """The planes of the field hexplane."""

    features: int = option(32, "number of features per plane")
    space: int = option(64, "resolution of the coarsest planes along each spatial axis")
    time: int = option(75, "resolution along the time axis")
    levels: int = option(2, "number of resolution levels; each doubles the spatial resolution of the level before")

    def __post_init__(self) -> None:
        if not (1 <= self.features <= 256 and 2 <= self.space <= 4096 and 2 <= self.time <= 4096):
            raise ValueError(
                "features must be 1 to 256, space and time 2 to 4096, "
                f"got {self.features}, {self.space} and {self.time}"
            )
        if not 1 <= self.levels <= 6:
            raise ValueError(f"levels must be 1 to 6, got {self.levels}")


@dataclass(frozen=True)
class FieldConfig:
    """The shape of a field."""

    kind: FieldKind = option(
        "laplacian",
        "deformation field: static (no motion), mlp (deformable 3DGS), hexplane (4D-GS), grid4d (Grid4D) or "
        "laplacian (the paper's); changes the field only, whereas --field also turns off the paper's other "
        "parts for the other methods",
    )
    bound: float = option(
        1.6, "half side length of the cube that the encoder covers, world units; outside it the features are zero"
    )
    static: HashConfig = option(HashConfig(16, (16, 16, 16), (2048, 2048, 2048)), "spatial hash grid (x, y, z)")
    temporal: HashConfig = option(HashConfig(32, (8, 8, 8), (32, 32, 16)), "space-time hash grids (two axes and time)")
    planes: PlaneConfig = option(PlaneConfig(), "planes of the field hexplane")
    width: int = option(256, "width of the decoder's layers")
    depth: int = option(0, "number of hidden layers between the fused features and the output heads")
    time_scale: float = option(0.9, "fraction of the temporal grids' time axis that the clip occupies")
    temporal_hash: bool = option(True, "grid4d and laplacian: use the three space-time hash grids")
    motion: Motion = option(
        "laplacian",
        "field laplacian: how motion is decoded; laplacian: as a sum of sinusoids (the motion spectrum); mlp: "
        "by an MLP of features and time instead",
    )
    components: int = option(16, "number of frequencies in the motion spectrum")
    frequency_step: float = option(
        1.0, "initial spacing of the spectrum's frequencies, which start at 0; cycles per clip"
    )
    amplitude: float = option(
        0.3, "initial standard deviation of the sum of the spectrum's components; useful values are 0.03 to 1"
    )
    dynamics: int = option(16, "field laplacian: length of the dynamics attribute of each Gaussian; 0: none")
    appearance: Appearance = option("color", "field laplacian: what the field changes over time besides geometry")

    def __post_init__(self) -> None:
        if not (0 < self.bound < 1e6 and 0 < self.time_scale <= 1):
            raise ValueError(
                "bound must be above 0 and time_scale above 0 and at most 1, "
                f"got {self.bound:g} and {self.time_scale:g}"
            )
        if not 0 < self.frequency_step < 1e6:
            raise ValueError(f"frequency_step must be above 0, got {self.frequency_step:g}")
        if not 0 < self.amplitude < 1e6:
            raise ValueError(f"amplitude must be above 0, got {self.amplitude:g}")
        for name, value, least, most in (
            ("width", self.width, 1, MAX_WIDTH),
            ("depth", self.depth, 0, MAX_DEPTH),
            ("components", self.components, 1, MAX_COMPONENTS),
            ("dynamics", self.dynamics, 0, MAX_DYNAMICS),
        ):
            if not least <= value <= most:
                raise ValueError(f"{name} must be {least} to {most}, got {value}")

    @property
    def dynamics_size(self) -> int:
        """Length of a Gaussian's dynamics attribute; 0 where the field has no use for it."""
        return self.dynamics if self.kind == "laplacian" else 0

    @property
    def appearance_size(self) -> int:
        """Outputs of the appearance head of a grid field; 0 where it has none."""
        return {"none": 0, "color": 3, "color+opacity": 4}[self.appearance] if self.kind == "laplacian" else 0

    @property
    def decodes_on_device(self) -> bool:
        """Whether our kernels have the field's decoder: that of grid4d and laplacian without hidden layers, and without
        the decoder that stands in for the spectrum."""
        return not self.depth and (self.kind == "grid4d" or (self.kind == "laplacian" and self.motion == "laplacian"))

    def grid_time(self, t: float) -> float:
        """A time in [0, 1] as the place on the temporal grids' time axis."""
        return 0.5 * ((2.0 * t - 1.0) * self.time_scale + 1.0)


def static_grid(config: FieldConfig) -> GridShape:
    """The hash grid of the grid fields over space."""
    return GridShape(config.static, (0, 1, 2))


def temporal_grids(config: FieldConfig) -> list[GridShape]:
    """Those over time, too."""
    return [GridShape(config.temporal, axes) for axes in (TEMPORAL_AXES if config.temporal_hash else ())]


def plane_shapes(config: PlaneConfig) -> list[tuple[int, int, int, int]]:
    """(1, features, second axis, first axis) of each plane of the field hexplane, six for each resolution."""
    shapes = []
    for level in range(config.levels):
        sizes = [config.space << level] * 3 + [config.time]
        shapes += [(1, config.features, sizes[b], sizes[a]) for a, b in PLANES]
    return shapes
