"""Render modes, backgrounds and comparisons: constants that load neither torch nor wgpu."""

from __future__ import annotations

from typing import Literal

Mode = Literal["rgb", "depth", "alpha", "motion", "dynamics", "scale"]
Compare = Literal["off", "side", "split", "error"]
COMPARES: tuple[Compare, ...] = ("off", "side", "split", "error")
MODES: dict[Mode, str] = {
    "rgb": "colours",
    "depth": "depth, world units",
    "alpha": "how much is covered",
    "motion": "how far each Gaussian moves over the clip, world units",
    "dynamics": "length of each Gaussian's dynamics attribute",
    "scale": "largest standard deviation of each Gaussian, world units",
}
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5)}
