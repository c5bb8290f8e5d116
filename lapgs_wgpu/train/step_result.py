"""What a step of a training is given, and what it tells.

Values that are not finite are found in the step in which they appear, named, and kept from everything that lasts. A
step is judged by the length of all gradients and parameters together: one reduction over each tensor. It is not finite
where a value is not, and where a gradient's square overflows, which would end up in Adam's second moments.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.errors import NumericalError

Tensors = Mapping[str, Sequence[Tensor]]  # by name of a group, such as an optimizer's


class Scheduled(NamedTuple):
    """What the schedule says of a step, whose number is counted from 1.

    moving: whether the field moves the Gaussians. share: of the learning rates, which rise over the first steps. seen:
    whether density control takes the views in.
    """

    step: int
    moving: bool
    share: float
    seen: bool


class Skipped(NamedTuple):
    """A step that moved nothing. what: which values are not finite."""

    step: int
    view: str
    what: str

    def __str__(self) -> str:
        return f"step {self.step} was skipped: on view {self.view} {self.what}"


class Measured(NamedTuple):
    """What a step measured; see StepResult."""

    loss: float
    psnr: float
    skipped: Skipped | None = None
    terms: Mapping[str, float] = MappingProxyType({})


class StepResult:
    """A step that is done, or that the device is doing: what it measures is then waited for when it is asked for.

    Attributes:
        step: its number, counted from 1.
        steps: the number of all steps.
    """

    def __init__(self, step: int, steps: int, measured: Callable[[], Measured]) -> None:
        self.step, self.steps, self._measured = step, steps, measured

    @property
    def loss(self) -> float:
        """Of the step's view."""
        return self._measured().loss

    @property
    def psnr(self) -> float:
        """Of the step's view, dB."""
        return self._measured().psnr

    @property
    def skipped(self) -> Skipped | None:
        """None, or why the step changed nothing: values that were not finite."""
        return self._measured().skipped

    @property
    def terms(self) -> Mapping[str, float]:
        """What each term of the loss adds to it, weight included, by name: `l1`, `ssim` (of 1 - SSIM), `pyramid`,
        `ncc`, `smoothness`, `acceleration` and `dynamics`, as far as they were computed, and each of one's own."""
        return self._measured().terms


def finite(*groups: Tensors) -> bool:
    """Whether all values are finite, and the sum of their squares is."""
    tensors = [tensor.detach() for group in groups for each in group.values() for tensor in each if tensor.numel()]
    return not tensors or math.isfinite(torch.nn.utils.get_total_norm(tensors).item())


def cause(terms: Mapping[str, float], gradients: Tensors) -> str:
    """What is not finite in a step: of the terms of its loss, and of the gradients, as far as they are given."""
    bad = [f"the loss term {name} is {value}" for name, value in terms.items() if not math.isfinite(value)]
    bad += [f"the gradient of {name} is not finite, or too large" for name in _not_finite(gradients)]
    return "; ".join(bad or ["a gradient, or all together, are not finite, or too large"])


def check_parameters(parameters: Tensors) -> None:
    """Raises NumericalError where a parameter is not finite: no step can come from it."""
    if names := _not_finite(parameters):
        raise NumericalError(f"the parameters {', '.join(names)} are not finite, or too large")


def _not_finite(groups: Tensors) -> list[str]:
    return [name for name, tensors in groups.items() if not finite({name: tensors})]
