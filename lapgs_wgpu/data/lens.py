"""Lenses with distortion, and the resampling of their images to those of pinhole cameras, which is what we render.

The lens model is that of nerfies and of Brown (1966): three radial and two tangential coefficients, and a skew.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Pixels, Size
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Array

MAX_ZOOM = 4.0  # a lens that needs more has wrong coefficients


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of a camera; lenses of equal values are equal.

    width, height: size in pixels of the images for which the values hold.
    fx, fy, cx, cy, skew: intrinsics in pixels; pixel centers at + 0.5.
    radial: coefficients of r^2, r^4 and r^6. tangential: p1 and p2.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def size(self) -> Size:
        """(width, height)."""
        return self.width, self.height

    @property
    def K(self) -> Array:  # noqa: N802
        """(3, 3) intrinsics, the skew in row 0, column 1."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has neither distortion nor skew."""
        return not (any(self.radial) or any(self.tangential) or self.skew)

    @property
    def idealized(self) -> "Lens":
        """A pinhole of the same focal lengths that looks at the image's center, as much published code takes it."""
        return Lens(self.width, self.height, self.fx, self.fy, self.width / 2, self.height / 2)

    def resized(self, width: int, height: int) -> "Lens":
        """The same lens for images of another size."""
        x, y = width / self.width, height / self.height
        return Lens(
            width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y, self.skew * x,
            self.radial, self.tangential,
        )  # fmt: skip

    def project(self, rays: Array) -> Array:
        """Project rays (..., 2), x / z and y / z, to pixel coordinates (..., 2)."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        k1, k2, k3 = self.radial
        p1, p2 = self.tangential
        bend = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * bend + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * bend + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        u = self.fx * bent_x + self.skew * bent_y + self.cx
        return np.stack([u, self.fy * bent_y + self.cy], axis=-1)

    def pinhole(self, where: str) -> Array:
        """(3, 3) K of the pinhole camera of the same image size and the smallest zoom at which the image has no gaps.

        Raises InputError, whose message begins with `where`, if that takes a zoom above MAX_ZOOM.
        """
        width, height = self.width, self.height
        x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
        sides = np.meshgrid(x, y[[0, -1]]), np.meshgrid(x[[0, -1]], y)
        border = np.concatenate([np.stack(grid, axis=-1).reshape(-1, 2) for grid in sides])

        def covered(zoom: float) -> bool:
            rays = _rays(self._zoomed(zoom), border)
            source = self.project(rays)
            return self._unfolds(rays) and bool(((source > 0) & (source < [width, height])).all())

        low, high = 1.0, MAX_ZOOM
        if covered(low):
            return self._zoomed(low)
        if not covered(high):
            values = ", ".join(f"{value:.3g}" for value in (*self.radial, *self.tangential))
            raise InputError(
                f"{where}: its distortion ({values}) leaves gaps even in an image {MAX_ZOOM:g} times as big; check it."
            )
        for _ in range(20):
            middle = (low + high) / 2
            low, high = (low, middle) if covered(middle) else (middle, high)
        return self._zoomed(high)

    def _unfolds(self, rays: Array) -> bool:
        """Whether the radial distortion is monotonic up to these rays (N, 2)."""
        r2 = np.linspace(0, 1, 64) * np.square(rays).sum(axis=-1).max()
        k1, k2, k3 = self.radial
        return bool((1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0).all())

    def _zoomed(self, zoom: float) -> Array:
        return np.array([[zoom * self.fx, 0, self.cx], [0, zoom * self.fy, self.cy], [0, 0, 1]])


class Undistortion(NamedTuple):
    """Resamples images of `lens`, at its size, to those of a pinhole camera with intrinsics K (3, 3)."""

    lens: Lens
    K: Array

    def apply(self, image: Pixels) -> Pixels:
        """Resample an image (H, W, C) bilinearly to the pinhole's, of the same size; one of a pinhole stays as it is.

        Colors weigh by their alpha, so that those of transparent pixels do not bleed into edges.
        """
        if self.lens.is_pinhole:
            return image
        from scipy.ndimage import map_coordinates  # takes most of a second to import

        height, width = image.shape[:2]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        source = self.lens.project(_rays(self.K, np.stack([columns, rows], axis=-1))) - 0.5
        places = [source[..., 1], source[..., 0]]

        def resampled(channel: NDArray[Any]) -> NDArray[np.float32]:
            return map_coordinates(channel, places, np.float32, order=1, mode="nearest")

        channels = np.moveaxis(image, -1, 0)
        if len(channels) == 3:
            values: list[NDArray[Any]] = [resampled(channel) for channel in channels]
        else:
            weight = channels[3].astype(np.float32)
            alpha = resampled(weight)
            covered = np.where(alpha > 0, alpha, 1)
            values = [*(resampled(channel * weight) / covered for channel in channels[:3]), alpha]
        return np.floor(np.stack(values, axis=-1) + 0.5).astype(np.uint8)


def _rays(K: Array, pixels: Array) -> Array:
    """Rays (..., 2), x / z and y / z, of `pixels` (..., 2) of a pinhole camera."""
    return (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
