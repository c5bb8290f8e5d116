"""What a training is given by Python, beside its configuration (docs/api.md)."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from torch import nn

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.densify import DensityRule, published_rule
from lapgs_wgpu.train.loss_terms import TAKEN_NAMES, LossTerm
from lapgs_wgpu.train.optimizer import FrequencyOptimizer
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

    Raises:
        InputError: a loss or a rate is of another kind, or two losses have one name.
    """

    field: nn.Module | None = None
    losses: Sequence[LossTerm] = ()
    density: DensityRule = published_rule
    rates: Mapping[str, Rate | float] = dataclasses.field(default_factory=dict)
    callbacks: Sequence[Callback] = ()

    def __post_init__(self) -> None:
        names = Counter(TAKEN_NAMES)
        for term in self.losses:
            if not isinstance(term, LossTerm):
                raise InputError(f"Parts(losses=...) must list Regularizer and TorchLoss, got a {type(term).__name__}.")
            names[term.name] += 1
            if names[term.name] > 1:
                raise InputError(f"there are two loss terms named {term.name!r}; give each a name of its own.")
        for name, rate in self.rates.items():
            number = isinstance(rate, int | float) and 0 <= rate < math.inf
            if not number and not isinstance(rate, Rate):
                raise InputError(f"Parts(rates=...) gives {name} {rate!r}; give 0 or more, or Rate(start, end, steps).")

    def rates_of(
        self, configured: Mapping[str, Rate], gaussians: Collection[str], groups: Collection[str]
    ) -> dict[str, Rate]:
        """The learning rate of each group of parameters, by name.

        Args:
            configured: those of the configuration.
            gaussians: names of the Gaussians' parameters.
            groups: names of the field's groups.

        Raises:
            InputError: a group has no rate, or the name of other parameters, or a rate has no group.
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
