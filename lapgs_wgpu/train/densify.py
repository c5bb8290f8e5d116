"""Density control, as in 3DGS (Kerbl et al. 2023, section 5.2): Gaussians are cloned, split, pruned and dimmed.

Everything works on a mapping of rows: name -> (N, ...) tensor, of which means, log_scales, quats and opacity_logits
are looked at, and dynamics by the adaptive split; whatever else a Gaussian carries is inherited by its children.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rotation import rotation_matrices
from lapgs_wgpu.train.adaptive_split import adaptive_split
from lapgs_wgpu.train.config import DensityConfig

CHILDREN = 2  # of a split Gaussian
SPLIT_SIZE = 0.01  # of the cameras' extent; smaller Gaussians are cloned
RESET_OPACITY = 0.01
# The most opaque Gaussians stay, these many or a quarter of all: where images show little but the background, all
# become faint together, and nothing could come back without any.
LEAST_KEPT = 256
SHRINK = 0.8 * CHILDREN  # how much smaller the children are

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
