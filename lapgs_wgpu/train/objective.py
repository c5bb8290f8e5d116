"""What a step lowers: the loss of a view, all terms together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.motion.fields.deformation import Moments, Nearby
from lapgs_wgpu.motion.fields.dynamics import dynamics_loss
from lapgs_wgpu.motion.scene import Deformed, Scene4D
from lapgs_wgpu.train.acceleration import acceleration_loss, draw_moments
from lapgs_wgpu.train.camera_refinement import RefinedCamera
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.fused_loss import RenderLoss, render_loss
from lapgs_wgpu.train.loss_terms import LossTerm, Regularizer, weight_at
from lapgs_wgpu.train.smoothness import draw_nearby

# Terms of the configuration, and what stands beside them in the log.
TERMS = frozenset({"l1", "mse", "ssim", "pyramid", "ncc", "smoothness", "acceleration", "dynamics", "loss", "psnr"})


class Sample(NamedTuple):
    """A view of a step, and what the losses of motion compare there.

    Attributes:
        view: of the training.
        background: (3,) that its image lies on.
        moving: whether the field moves the Gaussians.
        nearby: the places that the smoothness loss compares; None in steps without it.
        moments: those that the acceleration loss compares; None in steps without it.
    """

    view: View
    background: Tensor
    moving: bool
    nearby: Nearby | None
    moments: Moments | None


class Objective:
    """The loss of each view of a training.

    own: terms beside the configuration's (docs/api.md). moments: how many the clip has. extent: of the
    cameras, world units.

    Attributes:
        field_fitted: whether discovery has fitted the field to nearly all that moves. Its depth is known from there,
            and the acceleration loss is left out.
        scales: (N, 3) of the Gaussians of the last view, world units.
    """

    def __init__(self, config: Config, scene: Scene4D, own: Sequence[LossTerm], moments: int, extent: float) -> None:
        self._config, self._scene, self._own = config, scene, tuple(own)
        self._moments, self._extent = moments, extent
        self.field_fitted = False
        self.scales = scene.parameters["log_scales"].detach().exp()

    def sample(self, view: View, background: Tensor, step: int, generator: torch.Generator, *, moving: bool) -> Sample:
        """Draw what the losses of motion compare in a step, counted from 1."""
        config, count = self._config, len(self._scene)
        nearby = moments = None
        if moving and step > config.smoothness.start:
            t = self._scene.timing(view.time)
            nearby = draw_nearby(config.smoothness, count, t, generator)
            rests = self.field_fitted or step % config.acceleration.interval
            if not rests and self._scene.field is not None:
                moments = draw_moments(config.acceleration, count, t, self._moments, generator)
        return Sample(view, background, moving, nearby, moments)

    def loss(
        self,
        sample: Sample,
        step: int,
        truth: DeviceArray,
        camera: RefinedCamera,
        correction: Tensor | None,
    ) -> tuple[Tensor, RenderLoss, dict[str, float]]:
        """The loss of a view, its rendering, and what each term adds, by name.

        Args:
            sample: the view.
            step: counted from 1.
            truth: (H, W) of `upload_rgba`, the view's picture.
            camera: that sees it.
            correction: (3, 4) of the image's colors; None where they are taken as they are.
        """
        config, scene, time = self._config, self._scene, sample.view.time
        if sample.moving:
            now = scene.deformed(time, sample.nearby, sample.moments)
        else:
            now = Deformed(scene.canonical(), None, [])
        gaussians = now.gaussians
        self.scales = gaussians.scales.detach()
        weights = config.loss.weights(warm=sample.moving)
        weighted = [(term, weight) for term in self._own if (weight := weight_at(term, step))]
        own = [(term, weight) for term, weight in weighted if not isinstance(term, Regularizer)]
        rendering = render_loss(
            gaussians,
            camera.camera,
            truth,
            sample.background,
            weights,
            scene.device,
            correction,
            own,
            camera.change,
            self._extent,
        )
        beside: dict[str, Tensor] = {}
        if now.smoothness is not None:
            beside["smoothness"] = now.smoothness
        if sample.moments is not None:
            weight = config.acceleration.weight * config.acceleration.interval
            beside["acceleration"] = weight * acceleration_loss(now, scene.timing(time), sample.moments)
        if sample.moving and config.loss.dynamics and "dynamics" in scene.parameters:
            beside["dynamics"] = config.loss.dynamics * dynamics_loss(scene.parameters["dynamics"])
        for term, weight in weighted:
            if isinstance(term, Regularizer):
                beside[term.name] = weight * term.function(scene, gaussians, time)
        loss = rendering.loss
        for value in beside.values():
            loss = loss + value
        factors = {**weights._asdict(), **{term.name: weight for term, weight in own}}
        terms = {name: factors[name] * value for name, value in rendering.terms.items() if name in factors}
        return loss, rendering, terms | {name: value.item() for name, value in beside.items()}
