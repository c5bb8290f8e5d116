"""What a training is given by Python, beside its configuration (docs/api.md)."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.densify import DensityRule, published_rule
from lapgs_wgpu.train.ground_truth import host_image
from lapgs_wgpu.train.optimizer import FrequencyOptimizer
from lapgs_wgpu.train.step_result import StepResult


@dataclass(frozen=True)
class LossTerm:
    """A term of the loss, in torch: a `Regularizer` or a `TorchLoss`."""

    name: str
    function: Callable[..., Tensor]
    weight: float | Callable[[int], float] = 1.0

    def weight_at(self, step: int) -> float:
        """The weight in a step, counted from 1."""
        return float(self.weight(step) if callable(self.weight) else self.weight)


class Regularizer(LossTerm):
    """A term of the Gaussians, in torch.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        function: of the scene, its Gaussians at the view's time (activated, differentiable in the scene's parameters)
            and that time in [0, 1]; returns a scalar.
        weight: of the term, or a function of the step, counted from 1; at 0 it is not computed.
    """


class TorchLoss(LossTerm):
    """A term of the image, in torch. The image and its gradient then go through the host's memory in each step. Pixels
    that the losses leave out (data.masks) have the image's own color as ground truth, and no gradient.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        function: of the image (H, W, 3), differentiable, and the ground truth (H, W, 3) in [0, 1]; returns a scalar.
        weight: as in `Regularizer`.
    """


@dataclass(frozen=True)
class Parts:
    """Parts of a training that are Python objects.

    Attributes:
        field: a module that moves the Gaussians, in place of the configured field.
        losses: further terms of the loss.
        density: the rule of density control, called at the steps that the configuration plans for it.
        rates: learning rates by group of parameters: of the field's own groups, and in place of configured ones.
        callbacks: called after each whole step, in this order, with the Trainer and the result. An error that one
            raises ends the call of `Trainer.step`; the step stays done.

    Raises:
        InputError: a loss or a rate is of another kind, or two losses have one name.
    """

    field: nn.Module | None = None
    losses: Sequence[LossTerm] = ()
    density: DensityRule = published_rule
    rates: Mapping[str, Rate | float] = dataclasses.field(default_factory=dict)
    callbacks: Sequence[Callable[[Any, StepResult], object]] = ()

    def __post_init__(self) -> None:
        # By the terms of the configuration, and by what stands beside them in the log.
        taken = {"l1", "mse", "ssim", "pyramid", "ncc", "smoothness", "acceleration", "dynamics", "loss", "psnr"}
        for term in self.losses:
            if not isinstance(term, LossTerm):
                raise InputError(f"Parts(losses=...) must list Regularizer and TorchLoss, got a {type(term).__name__}.")
            if term.name in taken:
                raise InputError(f"there are two loss terms named {term.name!r}; give each a name of its own.")
            taken.add(term.name)
        for name, rate in self.rates.items():
            number = isinstance(rate, int | float) and 0 <= rate < math.inf
            if not number and not isinstance(rate, Rate):
                raise InputError(f"Parts(rates=...) gives {name} {rate!r}; give 0 or more, or Rate(start, end, steps).")

    def rates_of(
        self, configured: Mapping[str, Rate], gaussians: Collection[str], groups: Collection[str]
    ) -> dict[str, Rate]:
        """The learning rate of each group of parameters, by name.

        configured: those of the configuration. gaussians: names of the Gaussians' parameters. groups: names of the
        field's. Raises InputError where a group has no rate, or the name of other parameters, or a rate has no group.
        """
        own = {name: rate if isinstance(rate, Rate) else Rate(rate, rate, 1) for name, rate in self.rates.items()}
        rates = {**configured, **own}
        for name in groups:
            if name in gaussians or name == FrequencyOptimizer.name:
                raise InputError(f"the field's group {name} has the name of the training's own parameters; rename it.")
            if name not in rates:
                raise InputError(f"the field's group {name} has no learning rate; give Parts(rates={{{name!r}: ...}}).")
        for name in own:
            if name not in gaussians and name not in groups:
                known = ", ".join([*gaussians, *groups])
                raise InputError(f"Parts(rates=...) names {name}, which is no group of parameters; there are {known}.")
        return rates


def torch_loss(term: LossTerm, image: DeviceArray, truth: DeviceArray, weight: float) -> tuple[float, np.ndarray]:
    """The value of a term, and its weighted gradient (4, H, W) by the image.

    image: (4, H, W) red, green, blue, transmittance. truth: (H, W) uint32 RGBA of the ground truth. Raises
    InputError where the term returns no scalar.
    """
    planes, texels = read_all([image, truth])
    target, left_out = host_image(texels)
    with torch.enable_grad():
        shown = torch.from_numpy(planes[:3]).permute(1, 2, 0).requires_grad_()
        value = term.function(shown, torch.where(left_out, shown.detach(), target))
        if not isinstance(value, Tensor) or value.ndim:
            raise InputError(f"the loss {term.name!r} must return a scalar, got {getattr(value, 'shape', value)}.")
        d_image = np.zeros((4, *truth.shape), np.float32)
        if value.requires_grad:
            (gradient,) = torch.autograd.grad(value, shown, materialize_grads=True)
            d_image[:3] = weight * gradient.masked_fill(left_out, 0.0).permute(2, 0, 1).numpy()
    return float(value.detach()), d_image
