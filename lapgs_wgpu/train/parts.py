"""What a training is given by Python, beside its configuration (docs/api.md)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from torch import nn

from lapgs_wgpu.train.densify import DensityRule, published_rule
from lapgs_wgpu.train.learning_rate import Rate
from lapgs_wgpu.train.loss_terms import LossTerm
from lapgs_wgpu.train.step_result import StepResult


class Callback(Protocol):
    """Called after each step, with the Trainer, whose state is that of the whole step. An error that it raises ends the
    call of `Trainer.step`; the step stays done."""

    def __call__(self, trainer: Any, result: StepResult, /) -> object: ...


@dataclass(frozen=True)
class Parts:
    """Parts of a training that are Python objects.

    Attributes:
        field: a module that moves the Gaussians, in place of the configured field.
        losses: further terms of the loss.
        density: the rule of density control, called at the steps that the configuration plans for it.
        rates: learning rates by group of parameters: of the field's own groups, and in place of configured ones.
        callbacks: called after each step, in this order.
    """

    field: nn.Module | None = None
    losses: Sequence[LossTerm] = ()
    density: DensityRule = published_rule
    rates: Mapping[str, Rate | float] = dataclasses.field(default_factory=dict)
    callbacks: Sequence[Callback] = ()

    def schedules(self) -> dict[str, Rate]:
        """Learning rate of each group in `rates`."""
        return {name: rate if isinstance(rate, Rate) else Rate(rate, rate, 1) for name, rate in self.rates.items()}
