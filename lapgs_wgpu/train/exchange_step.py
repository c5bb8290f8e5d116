"""A training step by torch's autograd, which exchanges buffers with the kernels: on CPU devices, whose memory is
shared, and wherever torch computes a part of the step, such as a field or a loss of one's own. Image and loss are one
autograd function, `render_loss`, without either leaving the device."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.motion.fields.deformation import Deformed, Nearby, TimeSamples
from lapgs_wgpu.motion.fields.dynamics import dynamics_loss
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.drawing import camera_gradient
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import gradient_tensors, radii_and_centres, rasterizer_of, upload, upload_gaussians
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.exposure import expose, expose_bwd
from lapgs_wgpu.train.ground_truth import Draws
from lapgs_wgpu.train.image_loss import image_loss_of
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.motion_losses import acceleration_loss, compared_counts, even_times, near_time
from lapgs_wgpu.train.parts import LossTerm, Regularizer, torch_loss
from lapgs_wgpu.train.step_result import Measured, Scheduled, Skipped, cause, check_parameters, finite


class RenderLoss(NamedTuple):
    """A rendering that was compared with its ground truth.

    loss: a scalar, differentiable in the Gaussians' tensors, in the correction and in the camera's change. terms: l1,
    mse (mean squared error), ssim, pyramid and ncc (losses), as far as they were computed, and further terms by name;
    without weights. radii (N,), means2d (N, 2): as in splat.rasterize.Rendering.
    """

    loss: Tensor
    terms: dict[str, float]
    radii: Tensor
    means2d: Tensor


def render_loss(
    gaussians: Gaussians[Tensor],
    camera: Camera,
    truth: DeviceArray,
    background: Tensor,
    weights: LossWeights,
    device: Device,
    correction: Tensor | None = None,
    own: Sequence[tuple[LossTerm, float]] = (),
    camera_change: Tensor | None = None,
    camera_unit: float = 1.0,
) -> RenderLoss:
    """The weighted sum of the image losses of the rendered Gaussians, computed on the device from end to end.

    All passes are submitted at once, those of the gradients, too, and one read-back brings what the host needs. The
    same bits on every run of one adapter and driver.

    gaussians: activated, float32, with harmonics. truth: (H, W) as `upload_rgba` leaves it, of the camera's size.
    background: (3,) in [0, 1], under the rendering; not differentiable. correction: (3, 4) of the image's colors before
    they are compared (train/exposure). own: further terms of the image, with their weights. camera_change: (6,) zeros,
    which get the gradient by a small change of the camera: rotation, shift in units of `camera_unit`, world units
    (splat.drawing.camera_gradient).
    """
    rasterizer, losses = rasterizer_of(device), image_loss_of(device)
    arrays, (red, green, blue) = upload_gaussians(rasterizer.pool, gaussians), background.tolist()
    corrections = None if correction is None else upload(losses.pool, "correction", correction)
    while True:
        drawing = rasterizer.draw(arrays, camera, (red, green, blue), gradient=True)
        with Commands(device) as commands:
            image = drawing.image
            if corrections is not None:
                image = expose(commands, losses.pool, image, corrections)
            sums, d_image = losses.record(commands, image, truth, weights)
        own_values = []
        for term, weight in own:
            value, gradient = torch_loss(term, image, truth, weight)
            own_values.append(value)
            d_image.write(d_image.read() + gradient)
        d_small = []  # of the correction, then of the camera, where they are asked for
        if corrections is not None:
            with Commands(device) as commands:
                d_image, d_correction = expose_bwd(commands, losses.pool, drawing.image, d_image, corrections)
            d_small.append(d_correction)
        back = rasterizer.backward(drawing, d_image, camera=camera_change is not None)
        d_small += [] if back.camera is None else [back.camera]
        read = iter(read_all([sums, drawing.splats, *back.arrays(), *d_small, *drawing.needed]))
        values, splats, d_gaussians = next(read), next(read), [next(read) for _ in back.arrays()]
        small = [next(read) for _ in d_small]
        # Where the intersections did not fit, none of this is right, and all of it is done again.
        if not rasterizer.grow_on_overflow(drawing, list(read)):
            break
    by_gaussians, d_means2d = gradient_tensors(d_gaussians, gaussians.opacities.detach())
    by_correction = by_camera = None
    if correction is not None:
        by_correction = correction.new_tensor(small[0].sum(axis=0, dtype=np.float64))
    if camera_change is not None:
        by_rotation, by_center = camera_gradient(small[-1])
        by_camera = camera_change.new_tensor([*by_rotation, *(camera_unit * by_center)])
    radii, means2d = radii_and_centres(splats, gaussians.means.device)
    means2d.requires_grad_()
    computed = np.append(values.astype(np.float64), own_values)
    factors = {"l1": weights.l1, "mse": 0.0, **weights._asdict(), **{term.name: weight for term, weight in own}}
    gradients = (*by_gaussians, by_correction, by_camera, d_means2d)
    differentiable = (*gaussians.arrays().values(), correction, camera_change, means2d)
    loss = _Computed.apply(float(np.dot(computed, [*factors.values()])), gradients, *differentiable)
    named_values = zip(factors.items(), computed.tolist(), strict=True)
    terms = {name: value for (name, factor), value in named_values if factor or name in ("l1", "mse")}
    return RenderLoss(loss, terms, radii, means2d)


class _Computed(torch.autograd.Function):
    """A number whose gradients by some tensors are known: apply(number, gradients, *tensors)."""

    @staticmethod
    def forward(ctx: Any, value: float, gradients: tuple[Tensor | None, ...], *tensors: Tensor | None) -> Tensor:
        ctx.gradients = gradients
        return torch.tensor(value)

    @staticmethod
    def backward(ctx: Any, *d_outputs: Any) -> tuple[Tensor | None, ...]:
        scaled = (None if gradient is None else d_outputs[0] * gradient for gradient in ctx.gradients)
        return (None, None, *scaled)


class ExchangeStep:
    """Takes the steps of a training: the gradients of a view's loss, then the optimizers."""

    def __init__(self, learners: Learners, density: DensityControl, draws: Draws) -> None:
        self._learners, self._density, self._draws = learners, density, draws
        self._config, self._scene, self._time_count = learners.config, learners.scene, learners.dataset.time_count

    def take(self, scheduled: Scheduled, began: Callable[[], None]) -> Callable[[], Measured]:
        """Take a step; gives what it told.

        began: called before anything changes, after the last error that leaves all as it was.
        Raises NumericalError where a parameter is not finite.
        """
        step, view = scheduled.step, self._draws.next()
        t = self._scene.timing(view.time)
        compared = self._compared(scheduled, t)
        self._learners.zero_grad()
        measured, rendering = self._descend(scheduled, view, t, *compared)
        d_means2d = rendering.means2d.grad
        assert d_means2d is not None
        began()
        parameters, gradients = self._learners.parameters(), self._learners.gradients()
        gradients["the places in the image"] = [d_means2d]
        if math.isfinite(measured.loss) and finite(parameters, gradients):
            self._learners.step(step, scheduled.share)
            # After the optimizer's step, so that no gradient is lost with the rows that change.
            if scheduled.seen:
                self._density.statistics.add(rendering.radii, d_means2d, self._draws.truth.camera(view.camera))
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
        self, scheduled: Scheduled, view: View, t: float, nearby: Nearby | None, time_samples: TimeSamples | None
    ) -> tuple[Measured, RenderLoss]:
        """Add the gradients of a view's loss, at a time of the field, to those of all that learns."""
        config, scene, moving = self._config, self._scene, scheduled.moving
        learners, truth = self._learners, self._draws.truth
        now = scene.deformed(t, nearby, time_samples) if moving else Deformed(scene.canonical())
        weights = config.loss.weights(warm=moving)
        weighted = [(term, weight) for term in learners.parts.losses if (weight := term.weight_at(scheduled.step))]
        of_image = [(term, weight) for term, weight in weighted if not isinstance(term, Regularizer)]
        rendering = render_loss(
            now.gaussians,
            truth.camera(learners.camera(view)),
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
            of_motion["acceleration"] = weight * acceleration_loss(now, t, time_samples)
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
