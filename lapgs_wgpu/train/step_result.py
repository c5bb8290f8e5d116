"""What a step of a training tells."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from lapgs_wgpu.train.nonfinite import Skipped


class StepResult(NamedTuple):
    """A step that is done, of how many in all.

    loss, and psnr in dB: means over the step's views. skipped: where its values were not finite, so that it moved
    nothing. terms: what each term, times its weight, adds to the loss: l1, ssim (of 1 - SSIM), pyramid, ncc,
    smoothness and dynamics, as far as they were computed, and each term of one's own by its name.
    """

    step: int
    steps: int
    loss: float
    psnr: float
    skipped: Skipped | None = None
    terms: Mapping[str, float] = MappingProxyType({})
