"""The dynamics attributes d of the Gaussians: their outliers, and the loss L_dy (paper eqs. 10 to 12).

d: (N, D) float32, without a unit. The distance of a Gaussian is that between its row and the mean row.
"""

from torch import Tensor

# Tolerance: distances that are equal except for rounding are no outliers.
ROUNDING = 1e-6


def outliers(d: Tensor) -> Tensor:
    """Return a mask (N,) of the rows whose distance exceeds the mean distance by a standard deviation (eqs. 10, 11).

    The standard deviation of the N distances is divided by N, not by N - 1. If all rows are equal, none is an outlier.
    """
    distances = _offsets(d.detach()).norm(dim=1).double()
    mean = distances.mean()
    deviation = (distances - mean).square().mean().sqrt()
    return distances > (1 + ROUNDING) * mean + deviation


def dynamics_loss(d: Tensor) -> Tensor:
    """L_dy (eq. 12), a scalar: the sum of the outliers' squared distances, divided by N. Its descent pulls them to the
    mean row. The mean row and the choice of the outliers are constants to the gradient."""
    return (outliers(d) * _offsets(d).square().sum(dim=1)).sum() / max(len(d), 1)


def _offsets(d: Tensor) -> Tensor:
    return d - d.detach().mean(dim=0)
