"""What a step lowers: the loss of each view, all terms together, and its gradients.

`Objective.descend` is all that a training knows of how a view's gradients come about.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.motion.fields.config import MIN_SCALE
from lapgs_wgpu.motion.fields.deformation import Nearby, TimeSamples
from lapgs_wgpu.motion.fields.dynamics import dynamics_loss
from lapgs_wgpu.motion.scene import Deformed, Scene4D
from lapgs_wgpu.train.acceleration import acceleration_loss, draw_times
from lapgs_wgpu.train.camera_refinement import RefinedCamera
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.fused_loss import render_loss
from lapgs_wgpu.train.loss_terms import LossTerm, Regularizer, weight_at
from lapgs_wgpu.train.smoothness import draw_nearby


class Sample(NamedTuple):
    """A view of a step, and what the losses of motion compare there.

    Attributes:
        view: of the training.
        background: (3,) that its image lies on.
        moving: whether the field moves the Gaussians.
        nearby: the places that the smoothness loss compares; None in steps without it.
        time_samples: the times that the acceleration loss compares; None in steps without it.
    """

    view: View
    background: Tensor
    moving: bool
    nearby: Nearby | None
    time_samples: TimeSamples | None


class ViewResult(NamedTuple):
    """What a view's part of a step tells, besides the gradients.

    Attributes:
        loss: of the view, all terms together.
        psnr: of its image, dB.
        terms: what each term adds to the loss, by name.
        radii: (N,) of the Gaussians on the image, pixels.
        d_means2d: (N, 2) gradient of the view's share of the loss by the Gaussians' centers on the image, pixels.
    """

    loss: float
    psnr: float
    terms: dict[str, float]
    radii: Tensor
    d_means2d: Tensor


class Objective:
    """The loss of each view of a training.

    Args:
        config: resolved for the dataset.
        scene: that is trained.
        own_terms: terms beside those of the configuration (docs/api.md).
        time_count: the number of times of the clip.
        extent: of the cameras, world units.

    Attributes:
        field_fitted: whether discovery has fitted the field to nearly all that moves. Its depth is known from there,
            and the acceleration loss is left out.
    """

    def __init__(
        self, config: Config, scene: Scene4D, own_terms: Sequence[LossTerm], time_count: int, extent: float
    ) -> None:
        self._config, self._scene, self._own_terms = config, scene, tuple(own_terms)
        self._time_count, self._extent = time_count, extent
        self.field_fitted = False
        self._scales = scene.parameters["log_scales"].detach().exp()

    @property
    def dead_scales(self) -> float:
        """The share of the Gaussians' scales in the last view that are at the floor, where they get no gradient."""
        return float((self._scales <= MIN_SCALE).float().mean())

    def sample(self, view: View, background: Tensor, step: int, generator: torch.Generator, *, moving: bool) -> Sample:
        """Draw what the losses of motion compare in a step, counted from 1."""
        config, count = self._config, len(self._scene)
        nearby = time_samples = None
        if moving and step > config.smoothness.start:
            t = self._scene.timing(view.time)
            nearby = draw_nearby(config.smoothness, count, t, generator)
            left_out = self.field_fitted or step % config.acceleration.interval
            if not left_out and self._scene.field is not None:
                time_samples = draw_times(config.acceleration, count, t, self._time_count, generator)
        return Sample(view, background, moving, nearby, time_samples)

    def descend(
        self,
        sample: Sample,
        step: int,
        truth: DeviceArray,
        camera: RefinedCamera,
        correction: Tensor | None,
    ) -> ViewResult:
        """Add the gradients of a view's loss to those of all parameters that it depends on.

        Args:
            sample: the view.
            step: counted from 1.
            truth: (H, W) of `upload_rgba`, the view's image.
            camera: that sees it.
            correction: (3, 4) of the image's colors; None where they are taken as they are.
        """
        config, scene, time = self._config, self._scene, sample.view.time
        if sample.moving:
            now = scene.deformed(time, sample.nearby, sample.time_samples)
        else:
            now = Deformed(scene.canonical(), None, [])
        gaussians = now.gaussians
        self._scales = gaussians.scales.detach()
        weights = config.loss.weights(warm=sample.moving)
        weighted = [(term, weight) for term in self._own_terms if (weight := weight_at(term, step))]
        of_image = [(term, weight) for term, weight in weighted if not isinstance(term, Regularizer)]
        rendering = render_loss(
            gaussians,
            camera.camera,
            truth,
            sample.background,
            weights,
            scene.device,
            correction,
            of_image,
            camera.change,
            self._extent,
        )
        of_motion: dict[str, Tensor] = {}
        if now.smoothness is not None:
            of_motion["smoothness"] = now.smoothness
        if sample.time_samples is not None:
            weight = config.acceleration.weight * config.acceleration.interval
            of_motion["acceleration"] = weight * acceleration_loss(now, scene.timing(time), sample.time_samples)
        if sample.moving and config.loss.dynamics and "dynamics" in scene.parameters:
            of_motion["dynamics"] = config.loss.dynamics * dynamics_loss(scene.parameters["dynamics"])
        for term, weight in weighted:
            if isinstance(term, Regularizer):
                of_motion[term.name] = weight * term.function(scene, gaussians, time)
        loss = rendering.loss
        for value in of_motion.values():
            loss = loss + value
        loss.backward()
        assert rendering.means2d.grad is not None
        factors = {**weights._asdict(), **{term.name: weight for term, weight in of_image}}
        terms = {name: factors[name] * value for name, value in rendering.terms.items() if name in factors}
        terms |= {name: value.item() for name, value in of_motion.items()}
        return ViewResult(loss.item(), rendering.psnr, terms, rendering.radii, rendering.means2d.grad)
