"""The paper's adaptive split (equations 14 to 17): which large Gaussians of a large gradient are worth splitting.

One that resembles its neighbours in shape, and differs from each of them alike in dynamics, waits. All is computed in
float64 on the canonical Gaussians, in one order: the same rows give the same answer to the last bit.
"""

import math
from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from lapgs_wgpu.motion.fields.dynamics import outliers
from lapgs_wgpu.splat.rotation import rotation_matrices

NEIGHBOURS = 10  # that a Gaussian is compared with
DIVERGENCE_WEIGHT = 0.5  # of the differences in dynamics, relative to those in shape
SPLIT_QUANTILE = 0.4  # fraction of the candidates that are not split
LEAST_SHARE = 1e-2  # added to each neighbour's weight, in mean weights, so that none has the probability zero
TINY_WEIGHT = 1e-8  # and this, so that equal neighbours, whose weights are all zero, have equal probabilities
TINY_NORM = 1e-30  # only keeps 0 / 0 away, whatever the unit of the world is


@torch.no_grad()
def adaptive_split(rows: Mapping[str, Tensor], candidates: Tensor) -> Tensor:
    """(N,) bool: the candidates whose score tau reaches a quantile of all candidates' scores, and the outliers in d.

    rows: means (N, 3), log_scales (N, 3), quats (N, 4) wxyz, dynamics (N, D); without dynamics (an ablation) there are
    no outliers. candidates: (N,) bool.
    """
    of = candidates.nonzero()[:, 0]
    if len(of) == 0:
        return candidates
    scores = split_scores(rows, of)
    split = torch.zeros_like(candidates)
    split[of] = scores >= torch.quantile(scores, SPLIT_QUANTILE)
    if "dynamics" in rows:
        split |= candidates & outliers(rows["dynamics"])
    return split


def split_scores(rows: Mapping[str, Tensor], of: Tensor, count: int = NEIGHBOURS) -> Tensor:
    """tau (C,) of the Gaussians `of` (C,), by number (equation 17): how little they resemble their nearest neighbours.

    count: of neighbours; where there are fewer Gaussians, all others are. Zero for a Gaussian that is alone.
    """
    others = nearest(rows["means"], of, count)
    shapes = covariances(rows["log_scales"].double(), rows["quats"].double())
    features = rows["dynamics" if "dynamics" in rows else "means"].double()
    weights = (features[of][:, None] - features[others]).norm(dim=2)
    return shape_difference(shapes[of], shapes[others]) + DIVERGENCE_WEIGHT * divergence(probabilities(weights))


def nearest(means: Tensor, of: Tensor, count: int) -> Tensor:
    """(C, K) numbers of the nearest neighbours of the Gaussians `of` (C,), by distance, then by number (equation 14).

    means: (N, 3) world units. K = min(count, N - 1). Of several at the distance of the last neighbour, the tree decides
    which one counts; it does so in the same way each time.
    """
    points, rows = means.detach().cpu().double().numpy(), of.cpu().numpy()
    count = min(count, len(points) - 1)
    # One more than wanted, because a Gaussian also finds itself.
    distances, found = cKDTree(points).query(points[rows], k=range(1, count + 2), workers=1)
    # Itself goes last and falls off; where it is hidden behind others at the very same place, the furthest does.
    order = np.lexsort((found, distances, found == rows[:, None]))[:, :count]
    return torch.from_numpy(np.take_along_axis(found, order, axis=1)).to(of.device)


def covariances(log_scales: Tensor, quats: Tensor) -> Tensor:
    """(N, 3, 3) covariances R diag(s^2) R^T of Gaussians, squared world units."""
    axes = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return axes @ axes.mT


def shape_difference(own: Tensor, others: Tensor) -> Tensor:
    """(C,) in [0, 1]: Frobenius norm of the difference of covariances, relative to their norms (equation 15).

    own: (C, 3, 3). others: (C, K, 3, 3), over which the mean is taken. The paper's difference has a unit, but is added
    to a number that has none.
    """
    norms = own.norm(dim=(1, 2))[:, None] + others.norm(dim=(2, 3))
    differences = (own[:, None] - others).norm(dim=(2, 3)) / (norms + TINY_NORM)
    return differences.sum(dim=1) / max(others.shape[1], 1)


def probabilities(weights: Tensor) -> Tensor:
    """P (C, K) of equation 16: rows that sum to 1, from non-negative weights (C, K), each raised a little."""
    raised = weights + LEAST_SHARE * weights.mean(dim=1, keepdim=True) + TINY_WEIGHT
    return raised / raised.sum(dim=1, keepdim=True)


def divergence(p: Tensor) -> Tensor:
    """(C,) Kullback-Leibler divergence of probabilities (C, K) from the uniform ones, over ln K (equation 16).

    0 for the uniform ones, and for K < 2; 1 where a single neighbour has them all.
    """
    count = p.shape[1]
    return (torch.xlogy(p, p * count).sum(dim=1) / math.log(max(count, 2))).clamp(0.0, 1.0)
