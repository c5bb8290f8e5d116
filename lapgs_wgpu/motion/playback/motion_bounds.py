"""Bounds of each Gaussian's motion during playback, which tell the Gaussians that an image needs.

On the host: a hundred operations per Gaussian, whereas the field takes a hundred thousand.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS

Floats = NDArray[np.float32]

_FEW = 8  # parts of the clip that must have been seen before a Gaussian can count as still
_STILL_PIXELS = 0.25  # a still Gaussian moves less, one standard deviation from its mean, where its slope is steepest
_NEAR_PIXELS = 1.0  # a moving one whose values are not exact is off by less, at most
_STILL_SHADE = 1 / 64  # and opacity and colors change less, or are off by less
_BEYOND = 1.5  # factor of the box of the means: between the seen times a path may leave the box
_RIM = math.sqrt(-2 * math.log(CONSTANTS["ALPHA_MIN"]))  # standard deviations to the rim of an opaque Gaussian
_DILATED = _RIM * math.sqrt(CONSTANTS["DILATION"])  # pixels that the low-pass filter adds to a rim, at most


class MotionBounds:
    """Bounding boxes of the values that `count` Gaussians have had so far.

    parts: number of parts of the clip, each so short that the values hardly change within it.
    """

    def __init__(self, count: int, parts: int) -> None:
        self._parts = parts
        self._seen: set[int] = set()
        self._low = np.full((14, count), np.inf, np.float32)
        self._high = -self._low

    def add(self, values: Floats, t: float | None) -> None:
        """Extend the boxes by values (count, 14): mean, quaternion, scales, opacity, constant part of the color.

        t: their time in [0, 1]; None if they belong to several times.
        """
        np.minimum(self._low, values.T, out=self._low)
        np.maximum(self._high, values.T, out=self._high)
        if t is not None:
            self._seen.add(self._part(t))

    def _part(self, t: float) -> int:
        return min(int(t * self._parts), self._parts - 1)

    @np.errstate(invalid="ignore", over="ignore")  # non-finite values count as needed
    def needed(self, t: float, camera: Camera, error: Floats | None = None) -> NDArray[np.bool_]:
        """(count,) bool: Gaussians that an image at a time in [0, 1] needs with their values of exactly that time.

        Not needed are those whose box is so small that any values in it suffice, and those whose box is outside the
        image, as are then all values that were added. While too little of the clip was seen, all are needed.
        error: (14, count) bounds of the error of other values at hand, which suffice where it is small.
        """
        low, high = self._low, self._high
        if error is None and (len(self._seen) < min(_FEW, self._parts) or self._part(t) not in self._seen):
            return np.ones(low.shape[1], bool)
        path = np.sqrt(((high - low)[:3] ** 2).sum(axis=0))
        widest = high[7:10].max(axis=0)
        spread = 0.5 * _BEYOND * path

        focal, centre, pixels = camera.K[[0, 1], [0, 1]], camera.K[:2, 2], np.array([camera.width, camera.height])
        # Upper bound of the half axes of the image of a unit ball at depth 1 (`project`).
        tangent = np.maximum(centre, pixels - centre) / focal + CONSTANTS["FRUSTUM_MARGIN"] * 0.5 * pixels / focal
        stretch = focal * np.sqrt(1 + tangent**2)
        T = camera.T_cam_world.astype(np.float32)
        place = T[:3, :3] @ (0.5 * (low[:3] + high[:3])) + T[:3, 3:]
        depth = place[2]
        beside = depth + spread < CONSTANTS["NEAR"]
        for axis in (0, 1):  # pixels times depth
            at = focal[axis] * place[axis] + centre[axis] * depth
            reach = stretch[axis] * (spread + _RIM * widest) + _DILATED * np.maximum(depth, 0)
            beside |= (at + reach < 0) | (at - reach > pixels[axis] * depth)

        nearest = np.maximum(depth - spread, CONSTANTS["NEAR"]) / stretch.max()  # world units of a pixel
        enough = beside | _within(high - low, _STILL_PIXELS * nearest, widest)
        return ~enough if error is None else ~(enough | _within(error, _NEAR_PIXELS * nearest, widest))


def _within(change: Floats, length: Floats, widest: Floats) -> NDArray[np.bool_]:
    """(count,) bool: Gaussians of which changes (14, count) move nothing within a standard deviation of the mean by so
    much, and neither opacity nor colors visibly. widest: their largest scales."""
    shift, turn, growth = (np.sqrt((change[part] ** 2).sum(axis=0)) for part in (slice(3), slice(3, 7), slice(7, 10)))
    shade = np.maximum(change[10], CONSTANTS["SH_C0"] * change[11:].max(axis=0))
    within: NDArray[np.bool_] = (shift + growth + 2 * turn * widest < length) & (shade < _STILL_SHADE)
    return within  # a quaternion rotates by twice its angle
