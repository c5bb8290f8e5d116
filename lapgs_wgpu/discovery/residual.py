"""Where a training image differs from the static fit, and what a point in space looks like there."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lapgs_wgpu.data.evenly import evenly_indices
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.image_metrics import differing_pixels

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

FALLOFF = 1.5  # pixels; standard deviation of the mask's soft border
BLUR = 2.0  # pixels; standard deviation of the colors that views are compared by


def cubic_grid(axis: NDArray[Any]) -> NDArray[Any]:
    """(n^3, 3) places of a cubic grid with these coordinates (n,) along each axis."""
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


class Residual:
    """A training image at a time in [0, 1], and its moving pixels, the attribute mask (H, W).

    image: (H, W, 3) in [0, 1]. still: the same by the static fit. moving: (H, W), the moving pixels as masks tell them,
    which are completed; None to find them.
    """

    def __init__(self, camera: Camera, time: float, image: Floats, still: Floats, moving: Mask | None = None) -> None:
        self.camera, self.time, self.image, self.still = camera, time, image, still
        self.mask = differing_pixels(image, still)
        if moving is not None:  # masks from flow lack legs that are too fast for it
            labels, count = ndimage.label(ndimage.binary_fill_holes(self.mask))
            told = ndimage.mean(moving, labels, np.arange(count) + 1)
            self.mask = moving | np.isin(labels, 1 + np.flatnonzero(told > 0.3))

    @cached_property
    def _soft(self) -> Floats:
        """(H, W): 1 in the mask, falling off around it."""
        if not self.mask.any():
            return np.zeros(self.mask.shape, np.float32)
        distance = ndimage.distance_transform_edt(~self.mask)
        return np.exp(-0.5 * (distance / FALLOFF) ** 2).astype(np.float32)

    @cached_property
    def _blurred(self) -> Floats:
        """(H, W, 3): mean color of the moving pixels nearby."""
        weight = ndimage.gaussian_filter(self.mask.astype(np.float32), BLUR)[..., None]
        colors = ndimage.gaussian_filter(self.image * self.mask[..., None], (BLUR, BLUR, 0))
        return (colors / np.maximum(weight, 1e-3)).astype(np.float32)

    def sample(self, points: Floats) -> tuple[Floats, Floats, Mask]:
        """The mask (...) in [0, 1], blurred colors (..., 3), and whether the image shows them (...), of points
        (..., 3), world units, at the pixels that they project to."""
        K, T = self.camera.K.astype(np.float32), self.camera.T_cam_world.astype(np.float32)
        seen = points @ T[:3, :3].T + T[:3, 3]
        depth = seen[..., 2]
        at = seen[..., :2] / np.maximum(depth, 1e-3)[..., None] * K[[0, 1], [0, 1]] + K[:2, 2]
        height, width = self.mask.shape
        column, row = np.floor(at[..., 0]), np.floor(at[..., 1])
        inside = (depth > 1e-2) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = np.where(inside, row * width + column, 0).astype(np.int64)
        return self._soft.ravel()[pixel] * inside, self._blurred.reshape(-1, 3)[pixel], inside

    def moving_within(self, middle: NDArray[np.float64], radius: float) -> Mask:
        """(H, W), the moving pixels in a disc, both in pixels."""
        rows, columns = np.indices(self.mask.shape) + 0.5
        return self.mask & (np.hypot(columns - middle[0], rows - middle[1]) < radius)

    def rays(self, most: int) -> tuple[Floats, Floats, Floats]:
        """Of at most `most` moving pixels, evenly chosen, the directions (n, 3) of depth 1, the blurred colors (n, 3),
        and their own (n, 3)."""
        places = np.argwhere(self.mask)
        rows, columns = places[evenly_indices(len(places), most)].T
        K = self.camera.K
        u, v = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
        directions = np.stack([u, v, np.ones(len(rows))], axis=1) @ self.camera.T_cam_world[:3, :3]
        return directions.astype(np.float32), self._blurred[rows, columns], self.image[rows, columns]
