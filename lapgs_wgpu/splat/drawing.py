"""Results of the rasterizer's forward and backward passes, as arrays on the device."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.splat.buffer_plan import BufferPlan
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.gaussians import Gaussians


@dataclass(eq=False)
class Drawing:
    """A submitted image. Its arrays are valid until the rasterizer draws another one.

    image: (4, H, W) red, green, blue, transmittance; with `depth` (5, H, W), the last plane is the sum of weight times
    camera depth. splats: (N, SPLAT_FLOATS), see constants. needed: (3,) uint32 per band: number of intersections;
    unused; whether a list needs more rounds. number: counts the rasterizer's drawings. move: given a band's frame,
    records that of the moved camera, if it moves.
    arrays: by name what the passes of the band drawn last bind. Among them are the sorted lists of its tiles, uint32:
    tile_counts (N,) tiles of each Gaussian, 0 if it is not visible; visible (1,) number of Gaussians in the lists; ids
    (N,) the first visible[0] of them, by depth; offsets (N,) first slot of each of these; slot_ids (capacity,) the
    Gaussian of each slot; slots (capacity,) by tile and depth; ranges (tiles + 1, 4) first, end and drawn end of a
    tile's part of `slots`, then flags.
    """

    gaussians: Gaussians[DeviceArray]
    camera: Camera
    background: tuple[float, float, float]
    depth: bool
    plan: BufferPlan
    number: int
    image: DeviceArray
    splats: DeviceArray
    needed: list[DeviceArray]
    move: Callable[[Commands, DeviceArray, int], DeviceArray] | None = None
    arrays: dict[str, DeviceArray] = field(default_factory=dict)


def sh_defines(degree: int | None) -> dict[str, int]:
    """Return defines of color and color_bwd for harmonics of this degree, or for colors (None)."""
    if degree is None:
        return {}
    return {"SH": 1, "SH_COUNT": (degree + 1) ** 2} | {f"SH_{d}": 1 for d in range(1, degree + 1)}


class GaussianGradients(NamedTuple):
    """Gradients with respect to the Gaussians.

    splats: projected ones, (N, SPLAT_FLOATS), see constants. means (N, 3), quats (N, 4), scales (N, 3). sh:
    (N, K, 3); None for Gaussians with colors, whose gradient is a column of `splats`. camera: (2, G, 4), what
    `camera_gradient` takes; None where it was not asked for.
    """

    splats: DeviceArray
    means: DeviceArray
    quats: DeviceArray
    scales: DeviceArray
    sh: DeviceArray | None
    camera: DeviceArray | None = None

    def arrays(self) -> list[DeviceArray]:
        """Return the arrays of the Gaussians in this order, for `read_all`."""
        return [array for array in self[:5] if array is not None]


def camera_gradient(sums: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the gradient by a camera from the content of `GaussianGradients.camera`: (3,) by a small rotation of the
    camera about its own center, a vector along the world's axes, radians; (3,) by the center, world units."""
    turn, shift = sums.sum(axis=1, dtype=np.float64)
    return -turn[:3], -shift[:3]
