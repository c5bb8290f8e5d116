"""Values that are not finite: found in the step in which they appear, named, and kept from everything that lasts.

A step is judged by the length of all gradients and parameters together: one reduction over each tensor. It is not
finite where a value is not, and where a gradient's square overflows, which would end up in Adam's second moments.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.errors import NumericalError

IN_A_ROW = 10  # steps skipped one after the other that end a training
WINDOW, SHARE = 100, 25  # and so many of the last hundred

Tensors = Mapping[str, Sequence[Tensor]]  # by name of a group, such as an optimizer's


class Skipped(NamedTuple):
    """A step that moved nothing. what: which values are not finite."""

    step: int
    view: str
    what: str

    def __str__(self) -> str:
        return f"step {self.step} was skipped: on view {self.view} {self.what}"


def finite(*groups: Tensors) -> bool:
    """Whether all values are, and their squares can be summed up."""
    tensors = [tensor.detach() for group in groups for each in group.values() for tensor in each if tensor.numel()]
    if not tensors:
        return True
    return math.isfinite(torch.nn.utils.get_total_norm(tensors).item())


def describe(kind: str, group: Tensors) -> list[str]:
    """For each name how many of its values are not finite, or too large to be squared; [] where all are well."""
    found = []
    for name, tensors in group.items():
        count = sum(int((~tensor.detach().isfinite()).sum()) for tensor in tensors)
        if count:
            found.append(f"{count} of {sum(t.numel() for t in tensors)} values of the {kind} of {name} are not finite")
        elif not finite({name: tensors}):
            found.append(f"the {kind} of {name} is too large")
    return found


def cause(loss: float, terms: Sequence[Mapping[str, float]], gradients: Tensors) -> str:
    """What is not finite in a step: of its loss, of the terms of each view's loss, of its gradients."""
    bad = [f"the loss term {name} is {value}" for of in terms for name, value in of.items() if not math.isfinite(value)]
    bad = bad or ([] if math.isfinite(loss) else [f"the loss is {loss}"])
    return "; ".join([*bad, *describe("gradient", gradients)] or ["the gradients together are too large"])


class SkipCounter:
    """Counts the steps that were skipped."""

    def __init__(self) -> None:
        self._recent: deque[bool] = deque(maxlen=WINDOW)  # whether a step was skipped

    def note(self, skipped: Skipped | None) -> None:
        """Take in a step. Raises NumericalError where too many were skipped."""
        self._recent.append(skipped is not None)
        if skipped is None:
            return
        last = list(self._recent)[-IN_A_ROW:]
        if len(last) == IN_A_ROW and all(last):
            raise NumericalError(f"{IN_A_ROW} steps in a row had values that are not finite; the last: {skipped}")
        if sum(self._recent) >= SHARE:
            raise NumericalError(
                f"{SHARE} of the last {len(self._recent)} steps had values that are not finite; the last: {skipped}"
            )


def check_parameters(parameters: Tensors) -> None:
    """Raises NumericalError where a parameter is not finite: no step can come from it."""
    if not finite(parameters):
        raise NumericalError("; ".join(describe("parameters", parameters)))
