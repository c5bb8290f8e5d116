"""Adam with a learning-rate schedule for each group of parameters, whose state follows Gaussians that come and go."""

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion
from lapgs_wgpu.train.config import Rate

ADAM_EPS = 1e-15  # 3DGS's: gradients of single Gaussians are tiny
LARGEST_FREQUENCY_STEP = 0.02  # cycles over the clip


def rate_at(rate: Rate, step: int) -> float:
    """The learning rate of a step, which are counted from 1."""
    share = min(step / rate.steps, 1.0)
    if 0 in (rate.start, rate.end):  # which no exponential goes to
        return rate.start + share * (rate.end - rate.start)
    return rate.start ** (1 - share) * rate.end**share


class Optimizer:
    """Adam over the Gaussians' parameters, one group each, and over the field's groups.

    gaussians: name -> parameter with a row for each Gaussian. This very mapping is changed when rows come and go.
    field: group -> parameters, such as the field's `parameter_groups()`. rates: the schedule of each name and group.
    highest: name or group -> rate that it never exceeds. The same gradients in the same order give the same bits.
    on_access: called with "gaussians" or "field" before the state of these, or they with it, are read or changed from
    outside, without a name for both: a device may have newer ones. states: of Adam, by parameter, from its first step
    on: step, exp_avg and exp_avg_sq.
    """

    def __init__(
        self, gaussians: dict[str, nn.Parameter], field: Mapping[str, list[nn.Parameter]], rates: Mapping[str, Rate]
    ) -> None:
        groups = {name: [parameter] for name, parameter in gaussians.items()} | dict(field)
        self.gaussians = gaussians
        self.rates = dict(rates)
        self.highest: dict[str, float] = {}
        self.on_access: Callable[..., None] = lambda *parts: None
        # Fused: one pass over the memory, 2.5 times as fast as the others on the dnerf preset's hash tables.
        named = [{"params": parameters, "name": name} for name, parameters in groups.items()]
        self._adam = torch.optim.Adam(named, lr=0.0, eps=ADAM_EPS, fused=True)
        self.states: dict[Tensor, dict[str, Tensor]] = self._adam.state

    def parameters(self) -> dict[str, list[Tensor]]:
        """All that it moves, by group."""
        return {group["name"]: list(group["params"]) for group in self._adam.param_groups}

    def rates_at(self, step: int, share: float = 1.0) -> dict[str, float]:
        """The learning rate of each group in a step, counted from 1: a share of its schedule's."""
        names = [group["name"] for group in self._adam.param_groups]
        return {name: share * min(rate_at(self.rates[name], step), self.highest.get(name, math.inf)) for name in names}

    def step(self, step: int, share: float = 1.0) -> None:
        """Move every parameter that has a gradient, at a share of the rates of this step (counted from 1)."""
        rates = self.rates_at(step, share)
        for group in self._adam.param_groups:
            group["lr"] = rates[group["name"]]
        self._adam.step()
        # Fused Adam does not count what it writes, and a viewer knows by the count that it has to look again.
        for parameters in self.parameters().values():
            for parameter in parameters:
                if parameter.grad is not None:
                    torch.autograd.graph.increment_version(parameter)

    def edit_rows(self, rows: Tensor, added: Mapping[str, Tensor] | None = None) -> None:
        """Keep Gaussians with their state, those of a mask (N,) or of indices (M,) in their order, and append new ones.

        added: rows (K, ...) by name, which begin with a zero state; None for none.
        """
        self.on_access("gaussians")
        for name, old in self.gaussians.items():
            new = old.detach()[:0] if added is None else added[name]
            moments = {key: torch.cat([each[rows], torch.zeros_like(new)]) for key, each in self.moments(name).items()}
            self._replace(name, torch.cat([old.detach()[rows], new]), moments)

    def reset(self, name: str, values: Tensor) -> None:
        """Give one of the Gaussians' parameters new values (N, ...) and a zero state."""
        self.on_access("gaussians")
        self._replace(name, values, {key: torch.zeros_like(values) for key in self.moments(name)})

    def moments(self, name: str) -> dict[str, Tensor]:
        """Adam's exp_avg and exp_avg_sq of one of the Gaussians' parameters, shaped like it; empty before any step."""
        return {key: value for key, value in self.states.get(self.gaussians[name], {}).items() if key != "step"}

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, besides the parameters and their gradients."""
        self.on_access()
        return {
            f"{group['name']}.{i}.{key}": value
            for group in self._adam.param_groups
            for i, parameter in enumerate(group["params"])
            for key, value in self.states.get(parameter, {}).items()
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from what `state` gave, with parameters of the same shapes. Raises ValueError where they are others."""
        self.on_access()
        for group in self._adam.param_groups:
            for i, parameter in enumerate(group["params"]):
                prefix = f"{group['name']}.{i}."
                mine = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
                shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
                found = {key: value.shape for key, value in mine.items() if value.dtype == torch.float32}
                if mine and found != shapes:
                    raise ValueError(f"its {prefix[:-1]} holds {found}")
                if mine:
                    self.states[parameter] = mine

    def _replace(self, name: str, values: Tensor, moments: Mapping[str, Tensor]) -> None:
        state = self.states.pop(self.gaussians[name], {})
        parameter = self.gaussians[name] = nn.Parameter(values)
        if state:
            self.states[parameter] = {**state, **moments}
        next(group for group in self._adam.param_groups if group["name"] == name)["params"] = [parameter]


class FrequencyOptimizer:
    """Moves the frequencies of a spectrum along eq. 5's gradient.

    Adam, but with one second moment shared by all frequencies: one for each would divide the factor 1 / sigma_k^2, by
    which eq. 5 favours the faint components, away again. limit: the Nyquist frequency, cycles over the clip.
    """

    name = "frequencies"

    def __init__(self, motion: LaplacianMotion, rate: Rate, limit: float) -> None:
        self._motion, self.values, self.rate, self.limit = motion, motion.frequencies, rate, limit
        self._mean = torch.zeros_like(motion.frequencies)
        self._square, self._steps = torch.zeros((), dtype=torch.float64), torch.tensor(0)

    @torch.no_grad()
    def step(self, step: int) -> None:
        """Move the frequencies, if they have a gradient, at the rate of this step (counted from 1), and forget it."""
        if self.values.grad is None:
            return
        gradient = self._motion.frequency_gradient()
        self._steps += 1
        self._mean.copy_(0.9 * self._mean + 0.1 * gradient)
        self._square.copy_(0.999 * self._square + 0.001 * float(gradient.square().mean()))
        mean = self._mean / (1 - 0.9 ** int(self._steps))
        size = (float(self._square) / (1 - 0.999 ** int(self._steps))) ** 0.5
        move = rate_at(self.rate, step) * mean / (size + ADAM_EPS)
        self.values.sub_(move.clamp(-LARGEST_FREQUENCY_STEP, LARGEST_FREQUENCY_STEP)).clamp_(0.0, self.limit)
        self.values.grad = None

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, besides the frequencies and their gradient."""
        return {"mean": self._mean, "square": self._square, "steps": self._steps}
