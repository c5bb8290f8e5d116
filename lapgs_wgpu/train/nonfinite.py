"""Values that are not finite: found in the step in which they appear, named, and kept from everything that lasts.

A step is judged by the length of all gradients and parameters together: one reduction over each tensor. It is not
finite where a value is not, and where a gradient's square overflows, which would end up in Adam's second moments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.errors import NumericalError

MOST_SKIPPED = 10  # steps in a row, which end a training

Tensors = Mapping[str, Sequence[Tensor]]  # by name of a group, such as an optimizer's


class Skipped(NamedTuple):
    """A step that moved nothing. what: which values are not finite."""

    step: int
    view: str
    what: str

    def __str__(self) -> str:
        return f"step {self.step} was skipped: on view {self.view} {self.what}"


def finite(*groups: Tensors) -> bool:
    """Whether all values are finite, and the sum of their squares is."""
    tensors = [tensor.detach() for group in groups for each in group.values() for tensor in each if tensor.numel()]
    return not tensors or math.isfinite(torch.nn.utils.get_total_norm(tensors).item())


def cause(terms: Mapping[str, float], gradients: Tensors) -> str:
    """What is not finite in a step: of the terms of its loss, and of the gradients."""
    bad = [f"the loss term {name} is {value}" for name, value in terms.items() if not math.isfinite(value)]
    bad += [f"the gradient of {name} is not finite, or too large" for name in _not_finite(gradients)]
    return "; ".join(bad or ["the loss or all gradients together are too large"])


def check_parameters(parameters: Tensors) -> None:
    """Raises NumericalError where a parameter is not finite: no step can come from it."""
    if names := _not_finite(parameters):
        raise NumericalError(f"the parameters {', '.join(names)} are not finite, or too large")


def _not_finite(groups: Tensors) -> list[str]:
    return [name for name, tensors in groups.items() if not finite({name: tensors})]
