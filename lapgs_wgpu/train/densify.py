"""Density control, as in 3DGS (Kerbl et al. 2023, section 5.2): Gaussians are cloned, split, pruned and dimmed.

Everything works on a mapping of rows: name -> (N, ...) tensor, of which means, log_scales, quats and opacity_logits
are looked at, and dynamics by the adaptive split; whatever else a Gaussian carries is inherited by its children.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
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
# The most opaque Gaussians stay, these many or a quarter of all: where images show little but the background, all
# become faint together, and nothing could come back without any.
LEAST_KEPT = 256
SHRINK = 0.8 * CHILDREN  # how much smaller the children are

Rows = Mapping[str, Tensor]


@dataclass
class Statistics:
    """What was seen of N Gaussians since the last change of their number.

    gradients (N,): sum of the lengths of the image gradients, in normalised device coordinates. views (N,): how often
    each was visible. radii (N,): the largest radius on an image, in pixels.
    """

    gradients: Tensor
    views: Tensor
    radii: Tensor

    @staticmethod
    def zeros(count: int, device: torch.device) -> Statistics:
        """Nothing was seen yet."""
        return Statistics(*torch.zeros(3, count, device=device).unbind())

    def add(self, radii: Tensor, d_means2d: Tensor, camera: Camera, *, scale: float = 1.0) -> None:
        """Take in a view: radii (N,), pixels, and gradients (N, 2) by the centers on the image, per pixel.

        scale: of the gradients, where the view's loss had a share in a sum.
        """
        to_ndc = d_means2d.new_tensor([camera.width / 2, camera.height / 2])
        visible = radii > 0
        self.gradients += torch.where(visible, (d_means2d * (scale * to_ndc)).norm(dim=1), 0.0)
        self.views += visible
        self.radii = torch.maximum(self.radii, radii.to(self.radii.dtype))

    def merge(self, others: Iterable[Statistics]) -> None:
        """Take in what others have seen of the same Gaussians, in this order."""
        for other in others:
            self.gradients += other.gradients
            self.views += other.views
            self.radii = torch.maximum(self.radii, other.radii)

    def of(self, keep: Tensor) -> Statistics:
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
            normalized device coordinates; views (N,), the number of images in which each was visible; radii (N,), the
            largest in pixels.
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


def published_rule(state: DensityState) -> Change:
    """Density control as configured: 3DGS's, with the paper's adaptive split.

    Args:
        state: after a step.

    Returns:
        Which Gaussians stay, and which are added.
    """
    bound_sizes = state.step > state.config.reset_interval
    return densify(state.rows, state.statistics, state.config, state.extent, state.generator, bound_sizes=bound_sizes)


def check_change(change: Change, rows: Rows) -> None:
    """Raises InputError where a rule's result does not fit the Gaussians."""
    count = len(rows["means"])
    if change.keep.dtype != torch.bool or tuple(change.keep.shape) != (count,):
        raise InputError(f"keep must be bool of shape ({count},), got {change.keep.dtype} {tuple(change.keep.shape)}.")
    if change.added.keys() != rows.keys():
        raise InputError(f"added must have the rows {', '.join(rows)}, got {', '.join(change.added)}.")
    born = len(change.added["means"])
    for name, row in change.added.items():
        if row.shape != (born, *rows[name].shape[1:]) or row.dtype != rows[name].dtype:
            expected = (born, *rows[name].shape[1:])
            raise InputError(
                f"added[{name!r}] must be float32 of shape {expected}, got {row.dtype} {tuple(row.shape)}."
            )


@torch.no_grad()
def densify(
    rows: Rows,
    statistics: Statistics,
    config: DensityConfig,
    extent: float,
    generator: torch.Generator,
    *,
    bound_sizes: bool,
) -> Change:
    """What becomes of the Gaussians: small ones with a large gradient are doubled, large ones split, faint ones go.

    Large ones that the adaptive split passes over stay as they are.
    extent: of the cameras, world units. generator: where the children of a split are drawn from, on the CPU.
    bound_sizes: whether the bounds on screen and world size hold, which they do after the first opacity reset.
    """
    gradients = statistics.mean_gradients
    # Clones and children of faint ones are faint: they would go at once, and a split parent with them.
    wanted = (gradients >= config.gradient) & ~_faint(rows, config)
    large = rows["log_scales"].amax(dim=1) > math.log(config.split_size * extent)
    clone = wanted & ~large
    split = wanted & large
    if config.split == "adaptive":
        split = adaptive_split(rows, split, config)
    prune = prunable(rows, statistics.radii, config, extent, bound_sizes=bound_sizes)
    rescued = largest(rows["opacity_logits"], min(LEAST_KEPT, len(prune) // 4))
    prune &= ~rescued | oversized(rows, statistics.radii, config, extent, bound_sizes=bound_sizes)
    if config.limit:
        room = config.limit - int((~prune).sum())
        most = largest(torch.where((clone | split) & ~prune, gradients, -1.0), room)
        clone, split = clone & most, split & most
    clones = {name: row[clone] for name, row in rows.items()}
    children = split_rows({name: row[split] for name, row in rows.items()}, generator)
    born = {name: torch.cat([clones[name], children[name]]) for name in rows}

    # A Gaussian that was just born has not been seen on any image.
    unseen = torch.zeros_like(born["opacity_logits"])
    stillborn = prunable(born, unseen, config, extent, bound_sizes=bound_sizes)
    return Change(keep=~(split | prune), added={name: row[~stillborn] for name, row in born.items()})


def split_rows(parents: Rows, generator: torch.Generator) -> dict[str, Tensor]:
    """Two children (2 N, ...) for each of N parents: drawn from the parent as a distribution, and 1.6 times smaller."""
    rows = {name: row.repeat(CHILDREN, *[1] * (row.ndim - 1)) for name, row in parents.items()}
    normal = torch.randn(rows["means"].shape, generator=generator).to(rows["means"].device)
    offset = rotation_matrices(rows["quats"]) @ (normal * rows["log_scales"].exp())[:, :, None]
    rows["means"] = rows["means"] + offset[:, :, 0]
    rows["log_scales"] = rows["log_scales"] - math.log(SHRINK)
    return rows


def prunable(rows: Rows, radii: Tensor, config: DensityConfig, extent: float, *, bound_sizes: bool) -> Tensor:
    """(N,) which Gaussians are too faint, or too large (radii: (N,) largest so far on an image, pixels)."""
    return _faint(rows, config) | oversized(rows, radii, config, extent, bound_sizes=bound_sizes)


def _faint(rows: Rows, config: DensityConfig) -> Tensor:
    return rows["opacity_logits"] < _logit(config.min_opacity)


def oversized(rows: Rows, radii: Tensor, config: DensityConfig, extent: float, *, bound_sizes: bool) -> Tensor:
    """(N,) which Gaussians are too large; see `prunable`."""
    large = torch.zeros_like(rows["opacity_logits"], dtype=torch.bool)
    if bound_sizes and config.max_screen_radius > 0:
        large |= radii > config.max_screen_radius
    if bound_sizes and config.max_world_size > 0:
        large |= rows["log_scales"].amax(dim=1) > math.log(config.max_world_size * extent)
    return large


def largest(values: Tensor, count: int) -> Tensor:
    """(N,) bool: the `count` largest of values (N,), the first of equal ones."""
    chosen = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    chosen[torch.argsort(values, descending=True, stable=True)[: max(count, 0)]] = True
    return chosen


@torch.no_grad()
def reset_opacities(opacity_logits: Tensor, limit: float) -> Tensor:
    """Opacity logits (N,) lowered to those of `limit` where they are above."""
    return opacity_logits.clamp(max=_logit(limit))


def _logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity)) if opacity > 0 else -math.inf
