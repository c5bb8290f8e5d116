"""3D Gaussians at one time, activated, as the rasterizer takes them."""

from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from lapgs_wgpu.splat.constants import CONSTANTS

Array = TypeVar("Array")


def switched(antialiased: bool | float, on: bool | None) -> bool | float:
    """How Gaussians are drawn that have this `antialiased` where somebody asks for it, on or off; None for as it is."""
    return antialiased if on is None else on and (antialiased or True)


@dataclass(frozen=True, eq=False)
class Gaussians(Generic[Array]):
    """N Gaussians with their activations applied, float32: torch tensors, numpy arrays or DeviceArrays.

    Attributes:
        means: (N, 3) world units.
        quats: (N, 4) wxyz, any non-zero length.
        scales: (N, 3) standard deviations, world units.
        opacities: (N,) in [0, 1].
        sh: (N, K, 3) spherical harmonics with K = (degree + 1)^2 coefficients, degree 0 to 3; or view-independent
            colors (N, 3).
        antialiased: whether a Gaussian is drawn as much fainter as the rasterizer's low-pass filter makes it larger in
            the image (the 2-D filter of Mip-Splatting, arXiv 2311.16493), as it was trained; a number is the filter's
            variance, px².
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh: Array
    antialiased: bool | float = field(default=False, kw_only=True)

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by name, each with a row for every Gaussian."""
        return {name: value for name, value in vars(self).items() if name != "antialiased"}

    @property
    def low_pass(self) -> float:
        """Variance of the rasterizer's low-pass filter, px²: 0.3, as in 3DGS, where `antialiased` is no number."""
        return self.antialiased if self.antialiased and self.antialiased is not True else CONSTANTS["DILATION"]

    def __len__(self) -> int:
        means: Any = self.means
        return int(means.shape[0])

    @property
    def sh_degree(self) -> int | None:
        """Degree of the harmonics; None for colors."""
        sh: Any = self.sh
        return None if len(sh.shape) == 2 else int(sh.shape[1] ** 0.5) - 1
