"""What a step of a training tells."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from lapgs_wgpu.train.nonfinite import Skipped


class StepResult(NamedTuple):
    """A step that is done.

    Attributes:
        step: its number, counted from 1.
        steps: the number of all steps.
        loss: mean over the step's views.
        psnr: mean over the step's views, dB.
        skipped: None, or why the step changed nothing: values that were not finite.
        terms: what each term of the loss adds to it, weight included, by name: `l1`, `ssim` (of 1 - SSIM), `pyramid`,
            `ncc`, `smoothness`, `acceleration` and `dynamics`, as far as they were computed, and each of one's own.
        pruned: number of Gaussians that were pruned because they contribute too little.
    """

    step: int
    steps: int
    loss: float
    psnr: float
    skipped: Skipped | None = None
    terms: Mapping[str, float] = MappingProxyType({})
    pruned: int = 0
