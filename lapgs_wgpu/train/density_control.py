"""Density control of a training: the statistics that it gathers, and the changes that it makes after steps."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View, spread_views
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.train.densify import LEAST_KEPT, DensityState, Statistics, check_change, largest, reset_opacities
from lapgs_wgpu.train.learners import Learners

MOST_VIEWS = 50  # by which Gaussians are pruned


class DensityControl:
    """Clones, splits, prunes and dims the Gaussians of a scene at the steps that the configuration plans.

    statistics: of the Gaussians since the last change of their number.
    """

    def __init__(self, learners: Learners, generator: torch.Generator) -> None:
        self._learners, self._generator = learners, generator
        self._config, self._scene, self._optimizer = learners.config.density, learners.scene, learners.optimizer
        self.statistics = Statistics.zeros(len(self._scene))

    def change(self, step: int, *, moving: bool) -> None:
        """Make the changes that are planned after this step (counted from 1), with the optimizer's state.

        moving: whether the field moves the Gaussians. Raises InputError where no Gaussian would be left.
        """
        if self._config.prunes_at(step, self._learners.config.schedule.steps):
            self._prune_hidden(moving)
        if self._config.changes_at(step):
            self._apply_rule(step)
        if self._config.resets_at(step):
            logits = reset_opacities(self._scene.parameters["opacity_logits"])
            self._optimizer.reset("opacity_logits", logits)

    def _apply_rule(self, step: int) -> None:
        scene = self._scene
        rows = {name: row.detach() for name, row in scene.parameters.items()}
        extent = self._learners.dataset.extent
        state = DensityState(step, rows, self.statistics, self._config, extent, self._generator)
        change = self._learners.parts.density(state)
        check_change(change, rows)
        if not change.keep.any() and len(change.added["means"]) == 0:
            raise InputError(f"no Gaussian is left at step {step}; raise density.max_world_size (0 switches it off).")
        self._optimizer.edit_rows(change.keep, change.added)
        self._optimizer.edit_rows(morton_order(scene.parameters["means"].detach()))
        self.statistics = Statistics.zeros(len(scene))

    def _prune_hidden(self, moving: bool) -> None:
        shown = spread_views(self._learners.dataset.train, MOST_VIEWS)
        views = [dataclasses.replace(view, camera=self._learners.camera(view)) for view in shown]
        most = contributions(self._scene, views, moving=moving)
        keep = (most >= self._config.min_contribution) | largest(most, LEAST_KEPT)
        if not keep.all():
            self._optimizer.edit_rows(keep)
            self.statistics = self.statistics.of(keep)


def contributions(scene: Scene4D, views: Sequence[View], *, moving: bool) -> Tensor:
    """(N,) sum of the blending weights of a Gaussian over the pixels of a view, the largest over the views.

    In pixels: 1 is one pixel that shows nothing else. moving: whether the field moves the Gaussians; otherwise each
    view shows the canonical ones. The same bits on every run of one adapter and driver.
    """
    most = torch.zeros(len(scene), device=scene.parameters["means"].device)
    for view in views:
        with torch.no_grad():
            gaussians = scene.at(view.time) if moving else scene.canonical()
        colors = torch.zeros_like(gaussians.means, requires_grad=True)
        shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
        rendering = rasterize(
            *shape, colors, view.camera, antialiased=gaussians.antialiased, depth=False, device=scene.device
        )
        # The sums of the weights are the gradient of the sum of the image by the colors.
        (gradient,) = torch.autograd.grad(rendering.image[..., 0].sum(), colors)
        most = torch.maximum(most, gradient[:, 0])
    return most
