"""The order in which a training looks at its views."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lapgs_wgpu.data.views import View


class ViewOrder:
    """Views in random order without replacement, epoch after epoch.

    Attributes:
        left: the numbers of the views that are still to come in this epoch.
    """

    def __init__(self, views: Sequence[View], generator: torch.Generator) -> None:
        self._views, self._generator = views, generator
        self.left: list[int] = []

    def next(self) -> View:
        """The next view, which is not to come any more."""
        if not self.left:
            self.left = torch.randperm(len(self._views), generator=self._generator).tolist()
        return self._views[self.left.pop(0)]

    def coming(self, count: int) -> list[View]:
        """At most so many views that come after it in this epoch."""
        return [self._views[number] for number in self.left[:count]]
