"""What the rasteriser hands from its forward to its backward passes, as arrays on the device."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from ..gpu.array import DeviceArray
from .camera import Camera
from .gaussians import Gaussians


@dataclass(frozen=True)
class Plan:
    """How an image is drawn. None of it changes a bit.

    capacity: intersections (tile, splat) for which the lists have room. bands: of tile rows, drawn one after another.
    rounds: in which the tiles' lists are drawn.
    """

    capacity: int
    bands: int = 1
    rounds: int = 1


class TileLists(NamedTuple):
    """The lists of a band's tiles. visible: the number of Gaussians in them."""

    tile_counts: DeviceArray  # (N,) uint32, tiles of each Gaussian; 0: not visible
    visible: DeviceArray  # (1,) uint32
    sorted_ids: DeviceArray  # (N,) uint32, the first visible[0] of them, by depth
    offsets: DeviceArray  # (N,) uint32, of the same: their first slots
    slot_ids: DeviceArray  # (capacity,) uint32, the Gaussian of each slot
    slots: DeviceArray  # (capacity,) uint32, by tile and depth
    ranges: DeviceArray  # (tiles + 1, 4) uint32: first, end and drawn end of a tile's part of `slots`; then flags


@dataclass(eq=False)
class Drawing:
    """An image that was submitted. Its arrays are valid until the rasteriser draws the next one.

    image: (4, H, W) red, green, blue and transmittance, and with `depth` (5, H, W), the last the sum of weight times
    camera depth. splats: (N, SPLAT_FLOATS), see splat_layout. needed: (3,) uint32 of each band: its intersections;
    nothing; whether a list needs more rounds. lists: of the band that was drawn last. number: of this drawing among all
    of its rasteriser.
    """

    gaussians: Gaussians[DeviceArray]
    camera: Camera
    background: tuple[float, float, float]
    depth: bool
    plan: Plan
    number: int
    image: DeviceArray
    splats: DeviceArray
    needed: list[DeviceArray]
    lists: TileLists = field(init=False)

    @property
    def sh_defines(self) -> dict[str, int]:
        """Defines of color and color_bwd."""
        return sh_defines(self.gaussians.sh_degree)


def sh_defines(degree: int | None) -> dict[str, int]:
    """Defines of color and color_bwd for harmonics of this degree, or for colours (None)."""
    if degree is None:
        return {}
    return {"SH": 1, "SH_COUNT": (degree + 1) ** 2} | {f"SH_{d}": 1 for d in range(1, degree + 1)}


class GaussianGradients(NamedTuple):
    """Gradients by the projected splats (N, SPLAT_FLOATS), see splat_layout, by means (N, 3), quats (N, 4), scales
    (N, 3) and sh (N, K, 3), which is None where the Gaussians have colours: these are the splats'."""

    splats: DeviceArray
    means: DeviceArray
    quats: DeviceArray
    scales: DeviceArray
    sh: DeviceArray | None

    def arrays(self) -> list[DeviceArray]:
        """All of them, in this order (for `read_all`)."""
        return [array for array in self if array is not None]
