"""Split own footage into training and test frames (docs/own-data.md)."""

from __future__ import annotations

from collections.abc import Sequence

from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.errors import InputError

EVERY = 8  # one of so many times is tested: the fifth, the thirteenth, ...
FIRST = 4
CAMERAS = 3  # with so many cameras or more, the first camera is held out instead


def held_out(names: Sequence[ImageName], times: Sequence[float]) -> set[int]:
    """Return the indices of the test images.

    These are the images of the first camera, if there are three or more cameras; else those of every eighth time, from
    the fifth on. Raises InputError if there are too few.
    """
    cameras = sorted({name.camera for name in names}, key=natural_key)
    if len(cameras) >= CAMERAS:
        return {i for i, name in enumerate(names) if name.camera == cameras[0]}
    # If all times are equal, each image counts as a time of its own.
    distinct = sorted(set(times)) if len(set(times)) > 1 else []
    if distinct:
        tested = set(distinct[FIRST::EVERY])
        chosen = {i for i, time in enumerate(times) if time in tested}
    else:
        chosen = set(range(len(names))[FIRST::EVERY])
    if not chosen:
        raise InputError(
            f"{len(names)} images at {max(len(distinct), 1)} times are too few: every eighth time from the fifth on is "
            "held out for testing, so at least 5 are needed, or 3 cameras, of which the first is held out."
        )
    return chosen
