"""Lenses that bend straight lines: pictures are resampled to those of a pinhole camera, which is all that we draw.

The model is that of nerfies (and of Brown 1966): three radial and two tangential coefficients, and a skew.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.pictures import decode, shrink
from lapgs_wgpu.errors import InputError

Array = NDArray[np.float64]

LARGEST_ZOOM = 4.0  # a lens that needs more is no lens: its coefficients are wrong


@dataclass(frozen=True, eq=False)
class Lens:
    """What bends a picture of a camera.

    K: (3, 3) intrinsics in pixels, with the skew in row 0, column 1. radial: (3,), of r^2, r^4 and r^6.
    tangential: (2,).
    """

    K: Array
    radial: Array
    tangential: Array

    @property
    def is_pinhole(self) -> bool:
        """Whether it bends nothing."""
        return not (self.radial.any() or self.tangential.any() or self.K[0, 1])

    def project(self, rays: Array) -> Array:
        """Where rays (..., 2), x / z and y / z, meet the picture: (..., 2) in pixels, the first one's centre 0.5."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        k1, k2, k3 = self.radial
        p1, p2 = self.tangential
        bend = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * bend + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * bend + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        u = self.K[0, 0] * bent_x + self.K[0, 1] * bent_y + self.K[0, 2]
        return np.stack([u, self.K[1, 1] * bent_y + self.K[1, 2]], axis=-1)

    def pinhole(self, width: int, height: int) -> Array | None:
        """(3, 3) K of the pinhole camera whose picture of this size the bent one covers wholly, zoomed in no further
        than that needs; None where LARGEST_ZOOM does not do."""
        columns, rows = np.arange(width) + 0.5, np.arange(height) + 0.5
        top = np.stack([columns, np.full(width, 0.5)], axis=1)
        left = np.stack([np.full(height, 0.5), rows], axis=1)
        bottom, right = top + np.array([0, height - 1]), left + np.array([width - 1, 0])
        border = np.concatenate([top, bottom, left, right])

        def covered(zoom: float) -> bool:
            rays = _rays(self._zoomed(zoom), border)
            source = self.project(rays)
            return self._unfolds(rays) and bool(((source > 0) & (source < [width, height])).all())

        low, high = 1.0, LARGEST_ZOOM
        if covered(low):
            return self._zoomed(low)
        if not covered(high):
            return None
        for _ in range(20):
            middle = (low + high) / 2
            low, high = (low, middle) if covered(middle) else (middle, high)
        return self._zoomed(high)

    def straighten(self, picture: NDArray[np.uint8], K: Array) -> NDArray[np.uint8]:
        """The picture (H, W, C) as a pinhole camera K of the same size sees it, bilinearly resampled."""
        from scipy.ndimage import map_coordinates  # scipy takes most of a second to import: only where it is used

        height, width = picture.shape[:2]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        source = self.project(_rays(K, np.stack([columns, rows], axis=-1))) - 0.5
        where = [source[..., 1], source[..., 0]]
        out = np.empty_like(picture)
        for channel in range(picture.shape[2]):
            values = map_coordinates(picture[..., channel], where, np.float32, order=1, mode="nearest")
            out[..., channel] = np.floor(values + 0.5)
        return out

    def _unfolds(self, rays: Array) -> bool:
        """Whether what is further from the middle than something else stays further away, as far out as these rays."""
        r2 = np.linspace(0, 1, 64) * np.square(rays).sum(axis=-1).max()
        k1, k2, k3 = self.radial
        return bool((1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0).all())

    def _zoomed(self, zoom: float) -> Array:
        fx, fy = zoom * self.K[0, 0], zoom * self.K[1, 1]
        return np.array([[fx, 0, self.K[0, 2]], [0, fy, self.K[1, 2]], [0, 0, 1]])


def read_straight(
    path: Path, lens: Lens, K: Array, stored: tuple[int, int], size: tuple[int, int]
) -> NDArray[np.uint8]:
    """A picture of (width, height) `stored`, straightened for the pinhole camera K of that size and shrunk to `size`:
    (H, W, 3) RGB or (H, W, 4) RGBA. Raises InputError."""
    picture = decode(path)
    if picture.size != stored:
        raise InputError(f"{path} is {picture.size[0]}x{picture.size[1]} pixels now and was {stored[0]}x{stored[1]}.")
    return straightened(picture, lens, K, size)


def straightened(picture: Image.Image, lens: Lens, K: Array, size: tuple[int, int]) -> NDArray[np.uint8]:
    """An RGB or RGBA picture that `lens` took, for the pinhole camera K of its size and then shrunk to `size`."""
    if not lens.is_pinhole:
        picture = Image.fromarray(lens.straighten(np.asarray(picture), K))
    return shrink(picture, size)


def _rays(K: Array, pixels: Array) -> Array:
    """x / z and y / z (..., 2) of what a pinhole camera sees at `pixels` (..., 2)."""
    return (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
