"""What a training draws by chance: the order in which it looks at its views, and what else comes from its generator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View


class Mark(NamedTuple):
    """Where the draws stand: the generator's state, and the views that are left of an epoch."""

    random: Tensor
    left: list[int]


class Draws:
    """What the steps of a training draw: views in random order without replacement, epoch after epoch.

    left: the numbers of the views that are still to come in this epoch.
    """

    def __init__(self, views: Sequence[View], generator: torch.Generator) -> None:
        self._views, self.generator = views, generator
        self.left: list[int] = []

    def next(self) -> View:
        """The next view."""
        if not self.left:
            self.left = torch.randperm(len(self._views), generator=self.generator).tolist()
        return self._views[self.left.pop(0)]

    def coming(self, count: int) -> list[View]:
        """At most so many views that come after it in this epoch."""
        return [self._views[number] for number in self.left[:count]]

    def mark(self) -> Mark:
        """Where they stand, for `go_back`."""
        return Mark(self.generator.get_state(), list(self.left))

    def go_back(self, mark: Mark) -> None:
        """Draw again what was drawn since."""
        self.generator.set_state(mark.random)
        self.left = list(mark.left)
