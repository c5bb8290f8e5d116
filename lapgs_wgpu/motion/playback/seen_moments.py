"""Moments of the clip that playback has evaluated as a whole, and what lies between two of them."""

from __future__ import annotations

import bisect
import itertools

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_MOST_BYTES = 256 << 20  # of all moments


class SeenMoments:
    """The values of `count` Gaussians at some moments, in columns as `MotionBounds` has them: mean, quaternion, scales,
    opacity, constant part of the color.

    gap: the longest time between two moments that are joined; moments are kept that are a quarter of it apart. The
    first ones that fit into 256 MiB are kept.
    """

    def __init__(self, count: int, gap: float) -> None:
        self._gap = gap
        self._most = _MOST_BYTES // max(1, 14 * 4 * count)
        self._times: list[float] = []  # ascending
        self._values: list[Floats] = []  # (14, count) of each

    def add(self, values: Floats, t: float) -> None:
        """Keep values (count, 14) of a time in [0, 1], unless there are some near it."""
        at = bisect.bisect(self._times, t)
        near = self._times[max(0, at - 1) : at + 1]
        if len(self._times) < self._most and all(abs(t - other) >= self._gap / 4 for other in near):
            self._times.insert(at, t)
            self._values.insert(at, np.ascontiguousarray(values.T))

    def between(self, t: float) -> tuple[Floats, Floats] | None:
        """Values (14, count) at a time, on the straight line between the moments before and after it, and how far they
        are off at most.

        The bound follows from how far both moments are from the straight line between their own neighbors. It is that
        of a path with one kink, since features are piecewise linear in time; a parabola is off by a quarter of it.

        None where these four moments are not at hand, or further apart.
        """
        after = bisect.bisect(self._times, t)
        if not 2 <= after <= len(self._times) - 2:
            return None
        times, values = self._times[after - 2 : after + 2], self._values[after - 2 : after + 2]
        if max(b - a for a, b in itertools.pairwise(times)) > self._gap:
            return None
        share = np.float32((t - times[1]) / (times[2] - times[1]))
        found = values[1] + share * (values[2] - values[1])
        bent = _bend(times[:3], values[:3]) + _bend(times[1:], values[1:])
        return found, np.float32(2 * (t - times[1]) * (times[2] - t)) * bent


def _bend(times: list[float], values: list[Floats]) -> Floats:
    """Half the second derivative, without its sign, by three moments."""
    before, after = times[1] - times[0], times[2] - times[1]
    share = np.float32(before / (before + after))
    off: Floats = np.abs(values[1] - (values[0] + share * (values[2] - values[0])))
    return off / np.float32(before * after)
