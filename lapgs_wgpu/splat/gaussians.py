"""3D Gaussians at one moment, activated and ready to rasterise."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians with their activations applied.

    means: (N, 3) world units. quats: (N, 4) wxyz, any non-zero length. scales: (N, 3) standard deviations, world units.
    opacities: (N,) in [0, 1]. sh: (N, K, 3) spherical harmonics, K = (degree + 1)^2 coefficients, degree 0 to 3.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        return int(self.sh.shape[1] ** 0.5) - 1
