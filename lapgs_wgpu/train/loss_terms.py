"""Loss terms of one's own, beside those of the configuration (docs/api.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.ground_truth import host_image

Weight = float | Callable[[int], float]


@dataclass(frozen=True)
class Regularizer:
    """A term of the Gaussians, in torch.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        function: of the scene, its Gaussians at the view's time (activated, differentiable in the scene's parameters)
            and that time in [0, 1]; returns a scalar.
        weight: of the term, or a function of the step, counted from 1; at 0 it is not computed.
    """

    name: str
    function: Callable[[Scene4D, Gaussians[Tensor], float], Tensor]
    weight: Weight = 1.0


@dataclass(frozen=True)
class TorchLoss:
    """A term of the image, in torch. The image and its gradient then go through the host's memory in each step. Pixels
    that the losses leave out (data.masks) have the image's own color as ground truth, and no gradient.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        function: of the image (H, W, 3), differentiable, and the ground truth (H, W, 3) in [0, 1]; returns a scalar.
        weight: as in `Regularizer`.
    """

    name: str
    function: Callable[[Tensor, Tensor], Tensor]
    weight: Weight = 1.0


LossTerm = Regularizer | TorchLoss
# Names of the terms of the configuration, and of what stands beside them in the log.
TAKEN_NAMES = frozenset(
    {"l1", "mse", "ssim", "pyramid", "ncc", "smoothness", "acceleration", "dynamics", "loss", "psnr"}
)


def weight_at(term: LossTerm, step: int) -> float:
    """The weight of a term in a step, counted from 1."""
    return float(term.weight(step) if callable(term.weight) else term.weight)


def torch_loss(
    term: TorchLoss, image: DeviceArray, truth: DeviceArray, background: tuple[float, float, float], weight: float
) -> tuple[float, np.ndarray]:
    """The value of a term, and its weighted gradient (4, H, W) by the image.

    image: (4, H, W) red, green, blue, transmittance. truth: (H, W) uint32 RGBA of the ground truth, whose transparent
    pixels lie on the background. Raises InputError where the term returns no scalar.
    """
    planes, texels = read_all([image, truth])
    target, left_out = host_image(texels, torch.tensor(background))
    with torch.enable_grad():
        shown = torch.from_numpy(planes[:3]).permute(1, 2, 0).requires_grad_()
        value = term.function(shown, torch.where(left_out, shown.detach(), target))
        if not isinstance(value, Tensor) or value.ndim:
            raise InputError(f"the loss {term.name!r} must return a scalar, got {getattr(value, 'shape', value)}.")
        gradient = torch.zeros_like(shown)
        if value.requires_grad:
            (found,) = torch.autograd.grad(value, shown, allow_unused=True)
            gradient = gradient if found is None else found.masked_fill(left_out, 0.0)
    d_image = np.zeros((4, *truth.shape), np.float32)
    d_image[:3] = weight * gradient.permute(2, 0, 1).numpy()
    return float(value.detach()), d_image
