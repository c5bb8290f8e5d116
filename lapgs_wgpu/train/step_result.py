"""What a step of a training tells."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from lapgs_wgpu.train.nonfinite import Skipped


class Scheduled(NamedTuple):
    """What the schedule says of a step, whose number is counted from 1.

    moving: whether the field moves the Gaussians. share: of the learning rates, which rise over the first steps. seen:
    whether density control takes the views in.
    """

    step: int
    moving: bool
    share: float
    seen: bool


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
        """Mean over the step's views."""
        return self._measured().loss

    @property
    def psnr(self) -> float:
        """Mean over the step's views, dB."""
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
