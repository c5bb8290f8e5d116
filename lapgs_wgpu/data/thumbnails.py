"""Gray thumbnails of a film's images: how sharp they are, and which are blurred or repeat another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

THUMBNAIL = 320  # longer side, pixels: what is blurred or equal at this size is so for a training, too
BLURRED = 0.3  # relative to the sharpness of the images before and after
AROUND = 5  # number of images before, and after
EQUAL = 3  # levels of 255: the largest difference of a repeated image, above noise at this size
Array = NDArray[np.float64]


def sharpness(gray: NDArray[np.float32]) -> float:
    """Variance of the Laplacian of a thumbnail (H, W); 0 where it has no inner pixel."""
    if min(gray.shape) < 3:
        return 0.0
    inner = gray[1:-1, 1:-1]
    return float((gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * inner).var())


def blurred(values: Array) -> NDArray[np.bool_]:
    """(N,) whether each image is much less sharp than those around it, by the sharpness of all in the order of time."""
    if len(values) < 2:
        return np.zeros(len(values), bool)
    near = (np.delete(values[max(i - AROUND, 0) : i + AROUND + 1], min(i, AROUND)) for i in range(len(values)))
    return values < BLURRED * np.array([np.median(around) for around in near])


def repeats(gray: NDArray[np.float32], before: NDArray[np.float32]) -> bool:
    """Whether a thumbnail shows the same as the one before."""
    return gray.shape == before.shape and bool(np.abs(gray - before).max() <= EQUAL)
