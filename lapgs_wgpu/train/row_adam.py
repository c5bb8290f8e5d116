"""Adam for values of which a step moves a few rows: those of the images that it was trained on."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

MEAN_DECAY = 0.9
TINY = 1e-15  # keeps 0 / 0 away


class RowAdam:
    """The moments and step counts of rows, which stand still while a row has no gradient.

    Args:
        shape: of the values, rows first.
        square_decay: of the second moment.
    """

    def __init__(self, shape: tuple[int, ...], square_decay: float) -> None:
        self._square_decay = square_decay
        self._mean, self._square = torch.zeros(shape), torch.zeros(shape)
        self._steps = torch.zeros(shape[0], *[1] * (len(shape) - 1))

    def descend(self, gradient: Tensor, rate: float) -> tuple[Tensor, Tensor]:
        """The rows (R,) that have a gradient, and what to subtract from them (R, ...) at this learning rate."""
        rows = gradient.flatten(1).any(dim=1).nonzero()[:, 0]
        gradient, decay = gradient[rows], self._square_decay
        self._steps[rows] += 1
        self._mean[rows] = MEAN_DECAY * self._mean[rows] + (1 - MEAN_DECAY) * gradient
        self._square[rows] = decay * self._square[rows] + (1 - decay) * gradient.square()
        mean = self._mean[rows] / (1 - MEAN_DECAY ** self._steps[rows])
        size = (self._square[rows] / (1 - decay ** self._steps[rows])).sqrt()
        return rows, rate * mean / (size + TINY)

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, besides the gradient."""
        return {"mean": self._mean, "square": self._square, "steps": self._steps}


@torch.no_grad()
def restore_rows(mine: Mapping[str, Tensor], state: Mapping[str, Tensor], of: str) -> None:
    """Copy a state that was stored into the tensors that are in use, those of a `RowAdam` among them.

    of: what the values are, for the text of a ValueError, which is raised where the state is of another training.
    """
    for name, value in mine.items():
        other = state[name]
        if other.shape != value.shape or other.dtype != value.dtype or not bool(other.isfinite().all()):
            raise ValueError(f"its {of} {name} is {other.dtype} of shape {tuple(other.shape)}, or not finite")
    if bool((state["square"] < 0).any() or (state["steps"] < 0).any()):
        raise ValueError(f"its {of} moments are negative")
    for name, value in mine.items():
        value.copy_(state[name])
