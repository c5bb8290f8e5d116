"""What the measures of a capture are made of: the views that were looked at, and a number with its threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data import View
from lapgs_wgpu.data.images import Pixels
from lapgs_wgpu.prepare.masks import Mask
from lapgs_wgpu.splat.camera import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Measure:
    """One property. number: its value, NaN where it cannot be measured. value, threshold: as texts with units. good:
    None where it cannot be measured. advice: what to film differently, or why there is no number."""

    name: str
    number: float
    value: str
    threshold: str
    good: bool | None
    advice: str

    def __str__(self) -> str:
        mark = {True: "good", False: "POOR", None: "-"}[self.good]
        return f"{mark:>5}  {self.name}: {self.value} (wanted: {self.threshold})" + (
            "" if self.good else f". {self.advice[0].upper()}{self.advice[1:]}."
        )


@dataclass(frozen=True, eq=False)
class Look:
    """A view that was looked at. image: (h, w, 3) RGB. mask: (h', w') of what moves, None where there is none."""

    view: View
    image: Pixels
    mask: Mask | None


def distinct_cameras(views: Sequence[View]) -> list[Camera]:
    return list({id(view.camera): view.camera for view in views}.values())


def gray(image: Pixels) -> NDArray[np.float32]:
    """Gray levels (h, w), 0 to 255, of RGB."""
    return (image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)).astype(np.float32)
