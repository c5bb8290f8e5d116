"""Density control, as in 3DGS (Kerbl et al. 2023, section 5.2): Gaussians are cloned, split, pruned and dimmed.

The paper's adaptive split (equations 14 to 17) says which large Gaussians of a large gradient are worth splitting: one
that resembles its neighbours in shape, and differs from each of them alike in dynamics, waits. It is computed in
float64 on the canonical Gaussians, in one order: the same rows give the same answer to the last bit.

Everything works on a mapping of rows: name -> (N, ...) tensor, of which means, log_scales, quats and opacity_logits
are looked at, and dynamics by the adaptive split; whatever else a Gaussian carries is inherited by its children.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.motion.fields.dynamics import outliers
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rotation import rotation_matrices
from lapgs_wgpu.train.config import DensityConfig

CHILDREN = 2  # of a split Gaussian
SPLIT_SIZE = 0.01  # of the cameras' extent; smaller Gaussians are cloned
RESET_OPACITY = 0.01
# The most opaque Gaussians stay, these many or a quarter of all: where images show little but the background, all
# become faint together, and nothing could come back without any.
LEAST_KEPT = 256
SHRINK = 0.8 * CHILDREN  # how much smaller the children are
NEIGHBOURS = 10  # that the adaptive split compares a Gaussian with
DIVERGENCE_WEIGHT = 0.5  # of the differences in dynamics, relative to those in shape
SPLIT_QUANTILE = 0.4  # fraction of the candidates that are not split
LEAST_SHARE = 1e-2  # added to each neighbour's weight, in mean weights, so that none has the probability zero
TINY_WEIGHT = 1e-8  # and this, so that equal neighbours, whose weights are all zero, have equal probabilities
TINY_NORM = 1e-30  # only keeps 0 / 0 away, whatever the unit of the world is

Rows = Mapping[str, Tensor]


@dataclass
class Statistics:
    """What was seen of N Gaussians since the last change of their number.

    gradients (N,): sum of the lengths of the image gradients, in normalised device coordinates. views (N,): how often
    each was visible.
    """

    gradients: Tensor
    views: Tensor

    @staticmethod
    def zeros(count: int) -> "Statistics":
        """Nothing was seen yet."""
        return Statistics(*torch.zeros(2, count).unbind())

    def add(self, radii: Tensor, d_means2d: Tensor, camera: Camera) -> None:
        """Take in a view: radii (N,), 0 of what it does not show, and gradients (N, 2) by the centers, per pixel."""
        to_ndc = d_means2d.new_tensor([camera.width / 2, camera.height / 2])
        visible = radii > 0
        self.gradients += torch.where(visible, (d_means2d * to_ndc).norm(dim=1), 0.0)
        self.views += visible

    def of(self, keep: Tensor) -> "Statistics":
        """The statistics of the Gaussians of a mask (N,)."""
        return Statistics(*(values[keep] for values in vars(self).values()))

    @property
    def mean_gradients(self) -> Tensor:
        """(N,) mean over the views in which a Gaussian was visible; 0 for those never seen."""
        return self.gradients / self.views.clamp(min=1)


class Change(NamedTuple):
    """What becomes of N Gaussians.

    Attributes:
        keep: (N,) bool, which Gaussians stay, with their state of the optimizer.
        added: rows (M, ...) to append, with a fresh state; under the same names as `DensityState.rows`, all of them.
    """

    keep: Tensor
    added: dict[str, Tensor]


class DensityState(NamedTuple):
    """What density control decides on, after a step.

    Attributes:
        step: counted from 1.
        rows: parameters of the Gaussians by name, without gradients: means (N, 3) world units, log_scales (N, 3), quats
            (N, 4) wxyz of any length, opacity_logits (N,), sh_dc (N, 1, 3), sh_rest (N, 15, 3), and dynamics (N, D)
            where the field has them.
        statistics: since the last change: mean_gradients (N,), mean length of the gradient of the projected mean, in
            normalized device coordinates; views (N,), the number of images in which each was visible.
        config: the table `density` of the configuration.
        extent: of the cameras, world units.
        generator: seeded, for random numbers, on the CPU; with any other a training does not repeat.
    """

    step: int
    rows: Rows
    statistics: Statistics
    config: DensityConfig
    extent: float
    generator: torch.Generator


DensityRule = Callable[[DensityState], Change]


def check_change(change: Change, rows: Rows) -> None:
    """Raises InputError where a rule's result does not fit the Gaussians."""
    count = len(rows["means"])
    if change.keep.dtype != torch.bool or tuple(change.keep.shape) != (count,):
        raise InputError(f"keep must be bool of shape ({count},), got {change.keep.dtype} {tuple(change.keep.shape)}.")
    if change.added.keys() != rows.keys():
        raise InputError(f"added must have the rows {', '.join(rows)}, got {', '.join(change.added)}.")
    born = len(change.added["means"])
    for name, row in change.added.items():
        expected = (born, *rows[name].shape[1:])
        if row.shape != expected or row.dtype != rows[name].dtype:
            raise InputError(f"added[{name!r}] must be float32 {expected}, got {row.dtype} {tuple(row.shape)}.")


@torch.no_grad()
def published_rule(state: DensityState) -> Change:
    """Density control as configured: 3DGS's, with the paper's adaptive split.

    Small Gaussians with a large gradient are cloned and large ones split, unless the adaptive split passes over them;
    faint and oversized ones are pruned.

    Args:
        state: after a step.

    Returns:
        Which Gaussians stay, and which are added.
    """
    rows, config, gradients = state.rows, state.config, state.statistics.mean_gradients
    faint, oversized = _faint(rows, config), _oversized(state, rows)
    # Clones and children of faint ones are faint: they would go at once, and a split parent with them.
    wanted = (gradients >= config.gradient) & ~faint
    large = rows["log_scales"].amax(dim=1) > math.log(SPLIT_SIZE * state.extent)
    clone, split = wanted & ~large, wanted & large
    if config.split == "adaptive":
        split = adaptive_split(rows, split)
    prune = (faint & ~largest(rows["opacity_logits"], min(LEAST_KEPT, len(faint) // 4))) | oversized
    if config.limit:
        room = config.limit - int((~prune).sum())
        most = largest(torch.where((clone | split) & ~prune, gradients, -1.0), room)
        clone, split = clone & most, split & most
    clones = {name: row[clone] for name, row in rows.items()}
    children = split_rows({name: row[split] for name, row in rows.items()}, state.generator)
    born = {name: torch.cat([clones[name], children[name]]) for name in rows}
    alive = ~(_faint(born, config) | _oversized(state, born))
    return Change(keep=~(split | prune), added={name: row[alive] for name, row in born.items()})


@torch.no_grad()
def adaptive_split(rows: Rows, candidates: Tensor) -> Tensor:
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


def split_scores(rows: Rows, of: Tensor, count: int = NEIGHBOURS) -> Tensor:
    """tau (C,) of the Gaussians `of` (C,), by number (equation 17): how little they resemble their nearest neighbours.

    count: of neighbours; where there are fewer Gaussians, all others are. Zero for a Gaussian that is alone.
    """
    others = nearest(rows["means"], of, count)
    axes = rotation_matrices(rows["quats"].double()) * rows["log_scales"].double().exp()[:, None, :]
    covariances = axes @ axes.mT  # (N, 3, 3), squared world units
    features = rows["dynamics" if "dynamics" in rows else "means"].double()
    weights = (features[of][:, None] - features[others]).norm(dim=2)
    return shape_difference(covariances[of], covariances[others]) + DIVERGENCE_WEIGHT * divergence(
        probabilities(weights)
    )


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


def split_rows(parents: Rows, generator: torch.Generator) -> dict[str, Tensor]:
    """Two children (2 N, ...) for each of N parents: drawn from the parent as a distribution, and 1.6 times smaller."""
    rows = {name: row.repeat(CHILDREN, *[1] * (row.ndim - 1)) for name, row in parents.items()}
    normal = torch.randn(rows["means"].shape, generator=generator).to(rows["means"].device)
    offset = rotation_matrices(rows["quats"]) @ (normal * rows["log_scales"].exp())[:, :, None]
    rows["means"] = rows["means"] + offset[:, :, 0]
    rows["log_scales"] = rows["log_scales"] - math.log(SHRINK)
    return rows


def _faint(rows: Rows, config: DensityConfig) -> Tensor:
    return rows["opacity_logits"] < _logit(config.min_opacity)


def _oversized(state: DensityState, rows: Rows) -> Tensor:
    """(N,) bool: Gaussians that are too large, after the first opacity reset."""
    config, sizes = state.config, rows["log_scales"].amax(dim=1)
    bounded = state.step > config.reset_interval and config.max_world_size > 0
    return sizes > (math.log(config.max_world_size * state.extent) if bounded else math.inf)


def largest(values: Tensor, count: int) -> Tensor:
    """(N,) bool: the `count` largest of values (N,), the first of equal ones."""
    chosen = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    chosen[torch.argsort(values, descending=True, stable=True)[: max(count, 0)]] = True
    return chosen


@torch.no_grad()
def reset_opacities(opacity_logits: Tensor) -> Tensor:
    """Opacity logits (N,) lowered to that of RESET_OPACITY where they are above."""
    return opacity_logits.clamp(max=_logit(RESET_OPACITY))


def _logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity)) if opacity > 0 else -math.inf
