"""Which pixels of a capture's test views move, where nothing but its images is known.

- A test camera that stands still: pixels that differ from their median over the clip.
- Any other: pixels that differ from the rendering of a static fit, averaged over small windows, since a fit is nowhere
  exact at edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.views import View

THRESHOLD = 16  # levels of 255 in any channel: above the noise of a compressed video
LEAST_TIMES = 5  # of a camera, for a median
MOST_IMAGES = 64  # of a camera that the median is taken of, evenly over the clip
WINDOW = 5  # pixels: side of the windows over which the residual of a static fit is averaged

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def still_backgrounds(views: Sequence[View], load: Callable[[View], Image]) -> list[Image | None]:
    """For each view the median image (H, W, 3) of its camera over the clip, None where the camera moves.

    A camera stands still where at least LEAST_TIMES views of different times share its pose and intrinsics.

    Args:
        views: the test views.
        load: decodes a view and puts it on the background: (H, W, 3) uint8. Raises InputError.
    """
    groups: dict[bytes, list[int]] = {}
    for index, view in enumerate(views):
        camera = view.camera
        key = camera.K.tobytes() + camera.T_cam_world.tobytes() + bytes(f"{camera.width} {camera.height}", "ascii")
        groups.setdefault(key, []).append(index)
    result: list[Image | None] = [None] * len(views)
    for group in groups.values():
        ordered = sorted(group, key=lambda index: views[index].time)
        if len({views[index].time for index in ordered}) < LEAST_TIMES:
            continue
        middle = _median([load(views[index]) for index in evenly(ordered, MOST_IMAGES)])
        for index in group:
            result[index] = middle
    return result


def differs_from_median(truth: Image, background: Image) -> Mask:
    """Pixels (H, W) that differ from the median of the clip by more than THRESHOLD in any channel."""
    return (np.abs(truth.astype(np.int16) - background) > THRESHOLD).any(axis=2)


def differs_from_static(truth: Image, static: Image) -> Mask:
    """Pixels (H, W) where a static fit is off by more than THRESHOLD in any channel, in the mean of WINDOW x WINDOW."""
    return (np.abs(uniform_filter(truth.astype(np.float64) - static, (WINDOW, WINDOW, 0))) > THRESHOLD).any(axis=2)


def _median(images: Sequence[Image]) -> Image:
    """Per-pixel median, the lower of two middle values: of n (H, W, 3) images, a row at a time to save memory."""
    middle = (len(images) - 1) // 2
    rows = [
        np.partition(np.stack([image[row] for image in images]), middle, axis=0)[middle]
        for row in range(len(images[0]))
    ]
    return np.stack(rows)
