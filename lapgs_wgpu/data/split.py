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
    distinct = sorted(set(times))
    moments = times if len(distinct) > 1 else range(len(names))  # of equal times, each image counts as one of its own
    tested = set(sorted(set(moments))[FIRST::EVERY])
    chosen = {i for i, moment in enumerate(moments) if moment in tested}
    if not chosen:
        raise InputError(
            f"{len(names)} images at {len(distinct)} times are too few: every eighth time from the fifth on is held "
            "out for testing, so at least 5 are needed, or 3 cameras, of which the first is held out."
        )
    return chosen
