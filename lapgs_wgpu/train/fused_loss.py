"""A training step's image and loss without either leaving the device, as one autograd function."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.drawing import camera_gradient
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import gradient_tensors, radii_and_centres, rasterizer_of, upload, upload_gaussians
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.exposure import ExposurePasses
from lapgs_wgpu.train.image_loss import ImageLoss
from lapgs_wgpu.train.parts import LossTerm, torch_loss


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


# The passes of a device, whose buffers serve all calls of `render_loss`.
image_loss_of, exposure_of = functools.cache(ImageLoss), functools.cache(ExposurePasses)


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
    rasterizer, losses, exposing = rasterizer_of(device), image_loss_of(device), exposure_of(device)
    arrays, (red, green, blue) = upload_gaussians(rasterizer.pool, gaussians), background.tolist()
    corrections = None if correction is None else upload(exposing.pool, "correction", correction)
    while True:
        drawing = rasterizer.draw(arrays, camera, (red, green, blue), gradient=True)
        with Commands(device) as commands:
            image = drawing.image if corrections is None else exposing.record(commands, drawing.image, corrections)
            sums, d_image = losses.record(commands, image, truth, weights)
        own_values = []
        for term, weight in own:
            value, gradient = torch_loss(term, image, truth, weight)
            own_values.append(value)
            d_image.write(d_image.read() + gradient)
        rows = []
        if corrections is not None:
            with Commands(device) as commands:
                d_image, d_correction = exposing.record_bwd(commands, drawing.image, d_image, corrections)
            rows.append(d_correction)
        back = rasterizer.backward(drawing, d_image, camera=camera_change is not None)
        rows += [] if back.camera is None else [back.camera]
        read = iter(read_all([sums, drawing.splats, *back.arrays(), *rows, *drawing.needed]))
        values, splats, d_gaussians = next(read), next(read), [next(read) for _ in back.arrays()]
        d_rows = [next(read) for _ in rows]
        # Where the intersections did not fit, none of this is right, and all of it is done again.
        if not rasterizer.grow_on_overflow(drawing, list(read)):
            break
    by_gaussians, d_means2d = gradient_tensors(d_gaussians, gaussians.opacities.detach())
    by_correction = by_camera = None
    if correction is not None:
        by_correction = correction.new_tensor(d_rows[0].sum(axis=0, dtype=np.float64))
    if camera_change is not None:
        by_rotation, by_center = camera_gradient(d_rows[-1])
        by_camera = camera_change.new_tensor([*by_rotation, *(camera_unit * by_center)])
    radii, means2d = radii_and_centres(splats, gaussians.means.device)
    means2d.requires_grad_()
    computed = np.append(values.astype(np.float64), own_values)
    factors = {"l1": weights.l1, "mse": 0.0, **weights._asdict(), **{term.name: weight for term, weight in own}}
    gradients = (*by_gaussians, by_correction, by_camera, d_means2d)
    differentiable = (*gaussians.arrays().values(), correction, camera_change, means2d)
    loss = _Computed.apply(float(np.dot(computed, [*factors.values()])), gradients, *differentiable)
    found = zip(factors.items(), computed.tolist(), strict=True)
    terms = {name: value for (name, factor), value in found if factor or name in ("l1", "mse")}
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
