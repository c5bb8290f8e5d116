"""Learning rates over the steps of a training."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from lapgs_wgpu.io.dataclass_table import Options, option


@dataclass(frozen=True)
class Rate(Options):
    """A learning rate that goes from start to end exponentially, or in a straight line where one of them is 0, and then
    stays there."""

    start: float = option("initial value", at_least=0, below=math.inf)
    end: float = option("final value", at_least=0, below=math.inf)
    steps: int = option("step at which the final value is reached", at_least=1)

    def at(self, step: int) -> float:
        """The rate of a step, which are counted from 1."""
        share = min(step / self.steps, 1.0)
        if 0 in (self.start, self.end):  # which no exponential goes to
            return self.start + share * (self.end - self.start)
        return self.start ** (1 - share) * self.end**share


@dataclass(frozen=True)
class RatesConfig(Options):
    """Adam's learning rates, for each parameter of the Gaussians and for the field's hash tables and its MLP."""

    means: Rate = option("means, world units per step")
    log_scales: float = option("log-scales", at_least=0)
    quats: float = option("rotations (quaternions)", at_least=0)
    opacity_logits: float = option("opacities (logits)", at_least=0)
    sh_dc: float = option("base colors (spherical harmonics of degree 0)", at_least=0)
    sh_rest: float = option(
        "view-dependent colors (spherical harmonics of degree 1 to 3)",
        at_least=0,
    )
    dynamics: float = option("per-Gaussian dynamics attributes", at_least=0)
    hash: Rate = option("the field's hash tables or feature planes")
    mlp: Rate = option("the field's MLP weights, and the motion spectrum's coefficients")
    frequencies: Rate = option("the motion spectrum's frequencies, cycles per clip per step")

    def schedules(self) -> dict[str, Rate]:
        """Parameter name, or group of the field -> schedule."""
        rates = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: rate if isinstance(rate, Rate) else Rate(rate, rate, 1) for name, rate in rates.items()}
