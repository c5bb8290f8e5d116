"""What can be chosen of a picture, known without loading what draws it."""

from __future__ import annotations

from typing import Literal

Mode = Literal["rgb", "depth", "alpha", "motion", "dynamics", "scale"]
MODES: dict[Mode, str] = {
    "rgb": "colours",
    "depth": "depth, world units",
    "alpha": "how much is covered",
    "motion": "how far each Gaussian moves over the clip, world units",
    "dynamics": "length of each Gaussian's dynamics attribute",
    "scale": "largest standard deviation of each Gaussian, world units",
}
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5)}
