"""A training step by torch's autograd, which exchanges buffers with the kernels: on CPU devices, whose memory is
shared, and wherever torch computes a part of the step, such as a field or a loss of one's own."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.motion.fields.deformation import Deformed, Nearby, TimeSamples
from lapgs_wgpu.motion.fields.dynamics import dynamics_loss
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.fused_loss import RenderLoss, render_loss
from lapgs_wgpu.train.ground_truth import Draws
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.motion_losses import acceleration_loss, compared_counts, even_times, near_time
from lapgs_wgpu.train.parts import Regularizer
from lapgs_wgpu.train.step_result import Measured, Scheduled, Skipped, cause, check_parameters, finite


class ExchangeStep:
    """Takes the steps of a training: the gradients of a view's loss, then the optimizers."""

    def __init__(self, learners: Learners, density: DensityControl, draws: Draws) -> None:
        self._learners, self._density, self._draws = learners, density, draws
        self._config, self._scene, self._time_count = learners.config, learners.scene, learners.dataset.moments

    def take(self, scheduled: Scheduled, began: Callable[[], None]) -> Callable[[], Measured]:
        """Take a step; gives what it told.

        began: called before anything changes, after the last error that leaves all as it was.
        Raises NumericalError where a parameter is not finite.
        """
        step, view = scheduled.step, self._draws.next()
        compared = self._compared(scheduled, self._scene.timing(view.time))
        self._learners.zero_grad()
        measured, rendering = self._descend(scheduled, view, *compared)
        d_means2d = rendering.means2d.grad
        assert d_means2d is not None
        began()
        parameters, gradients = self._learners.parameters(), self._learners.gradients()
        gradients["the places in the image"] = [d_means2d]
        if math.isfinite(measured.loss) and finite(parameters, gradients):
            self._learners.step(step, scheduled.share)
            # After the optimizer's step, so that no gradient is lost with the rows that change.
            if scheduled.seen:
                self._density.statistics.add(rendering.radii, d_means2d, view.camera)
        else:
            check_parameters(parameters)  # whose values a step cannot mend
            measured = measured._replace(skipped=Skipped(step, view.name, cause(measured.terms, gradients)))
        return lambda: measured

    def _compared(self, scheduled: Scheduled, t: float) -> tuple[Nearby | None, TimeSamples | None]:
        """Draw what the losses of motion compare at a time of the field, None for each that is off."""
        config, count, generator, times = self._config, len(self._scene), self._draws.generator, self._time_count
        near, even = compared_counts(config, scheduled, count, times, fitted=self._learners.field_fitted > 0)
        nearby = time_samples = None
        if near:
            smooth, rows = config.smoothness, torch.randint(count, (near,), generator=generator)
            offsets = smooth.reach * (2 * torch.rand(near, 3, generator=generator) - 1)
            nearby = Nearby(rows, offsets, near_time(smooth, t, generator), smooth.static, smooth.temporal)
        if even and self._scene.field is not None:
            rows = torch.randint(count, (even,), generator=generator)
            time_samples = TimeSamples(rows, even_times(t, times, generator))
        return nearby, time_samples

    def _descend(
        self, scheduled: Scheduled, view: View, nearby: Nearby | None, time_samples: TimeSamples | None
    ) -> tuple[Measured, RenderLoss]:
        """Add the gradients of a view's loss to those of all that learns."""
        config, scene, moving = self._config, self._scene, scheduled.moving
        learners, truth = self._learners, self._draws.truth
        now = scene.deformed(view.time, nearby, time_samples) if moving else Deformed(scene.canonical(), None, [])
        weights = config.loss.weights(warm=moving)
        weighted = [(term, weight) for term in learners.parts.losses if (weight := term.weight_at(scheduled.step))]
        of_image = [(term, weight) for term, weight in weighted if not isinstance(term, Regularizer)]
        rendering = render_loss(
            now.gaussians,
            learners.camera(view),
            truth.on_device(view),
            truth.backgrounds[view],
            weights,
            scene.device,
            learners.exposure(view),
            of_image,
            learners.camera_change(view),
            learners.dataset.extent,
        )
        of_motion: dict[str, Tensor] = {}
        if now.smoothness is not None:
            of_motion["smoothness"] = now.smoothness
        if time_samples is not None:
            weight = config.acceleration.weight * config.acceleration.interval
            of_motion["acceleration"] = weight * acceleration_loss(now, scene.timing(view.time), time_samples)
        if moving and config.loss.dynamics and "dynamics" in scene.parameters:
            of_motion["dynamics"] = config.loss.dynamics * dynamics_loss(scene.parameters["dynamics"])
        for term, weight in weighted:
            if isinstance(term, Regularizer):
                of_motion[term.name] = weight * term.function(scene, now.gaussians, view.time)
        loss = rendering.loss
        for value in of_motion.values():
            loss = loss + value
        loss.backward()
        factors = {**weights._asdict(), **{term.name: weight for term, weight in of_image}}
        terms = {name: factors[name] * value for name, value in rendering.terms.items() if name in factors}
        terms |= {name: value.item() for name, value in of_motion.items()}
        return Measured(loss.item(), psnr_of(rendering.terms["mse"]), terms=terms), rendering
