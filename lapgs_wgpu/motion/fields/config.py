"""The configuration of a deformation field, and the sizes that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, field
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

    features: int = option(32, "features of a plane")
    space: int = option(64, "entries along a spatial axis of the coarsest planes")
    time: int = option(75, "entries along the time axis")
    levels: int = option(2, "sets of planes, each of twice the spatial resolution of the one before")

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
        "static (nothing moves), mlp (deformable 3DGS), hexplane (4D-GS), grid4d (Grid4D) or laplacian (the paper's); "
        "this key changes the field alone, --field also leaves out what belongs to the paper's method only",
    )
    bound: float = option(
        1.6, "half side of the box that the encoder covers, world units; outside it features are zero"
    )
    static: HashConfig = field(default_factory=lambda: HashConfig(16, (16, 16, 16), (2048, 2048, 2048)))
    temporal: HashConfig = field(default_factory=lambda: HashConfig(32, (8, 8, 8), (32, 32, 16)))
    planes: PlaneConfig = field(default_factory=PlaneConfig)
    width: int = option(256, "of the decoder")
    depth: int = option(0, "hidden layers between the fused features and the heads")
    time_scale: float = option(0.9, "share of the temporal grids' time axis that the clip fills")
    temporal_hash: bool = option(True, "whether grid4d and laplacian have the three temporal grids")
    motion: Motion = option(
        "laplacian", "of the field laplacian: laplacian (a spectrum), or mlp, a decoder of features and time instead"
    )
    components: int = option(16, "frequencies of the spectrum")
    frequency_step: float = option(
        1.0, "from one frequency to the next at the start, which is at 0; cycles over the clip"
    )
    amplitude: float = option(0.3, "standard deviation of the spectrum's sum at the start; 0.03 to 1 are reasonable")
    dynamics: int = option(16, "length of each Gaussian's dynamics attribute with the field laplacian; 0 for none")
    appearance: Appearance = option(
        "color", "what the field laplacian changes besides the geometry: none, color, or color+opacity"
    )

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
