"""Render modes, backgrounds and vertical axes: constants that load neither torch nor wgpu."""

from typing import Literal

Mode = Literal["rgb", "depth", "alpha", "motion"]
MODES: dict[Mode, str] = {
    "rgb": "colors",
    "depth": "depth along the camera axis, world units",
    "alpha": "opacity of the image",
    "motion": "largest distance of each Gaussian from its mean position over the clip, world units",
}
# Axis that points up -> the one along which the guessed camera looks.
AHEAD = {"x": "y", "y": "-z", "z": "y", "-x": "y", "-y": "z", "-z": "y"}
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5)}
