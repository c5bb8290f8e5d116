"""Surfaces of what stands still, by a plane sweep between cameras that stand still.

The median of a camera's images over the clip shows what does not move. Where a plane before a camera, at the depth of a
surface, carries the other cameras' images to it, they look as its own there. A depth is believed that other cameras'
depths confirm. Source: Collins, A space-sweep approach to true multi-image matching (CVPR 1996).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.views import Dataset, small_views
from lapgs_wgpu.splat.camera import Camera

Array = NDArray[np.float64]

SIDE = 168  # pixels, of the images that are compared
IMAGES = 25  # of a camera, whose median shows what stands still
CAMERAS = 24  # of a rig, at most
NEIGHBOURS = 6  # the nearest cameras, with which one is compared
DEPTHS = 128  # planes, evenly in 1 / depth
WINDOW = 7  # pixels; side of the square whose colors are compared
MIN_CORRELATION = 0.6  # normalized cross-correlation of a surface's image in two cameras
CONFIRMED = 2  # other cameras that must find the same depth
NEAR = 2.5  # planes by which two cameras' depths may differ
FLAT = 1e-8  # product of two variances, below which windows are flat and look like nothing


class Surface(NamedTuple):
    """points: (N, 3) world units. colors: (N, 3) in [0, 1]. share: of all pixels, those whose depth is point_count."""

    points: NDArray[np.float32]
    colors: NDArray[np.float32]
    share: float


class _Still(NamedTuple):
    """A camera, and what it sees that does not move: colors (H, W, 3) in [0, 1], their gray (H, W), and its mean and
    variance (H, W) over the window of each pixel."""

    camera: Camera
    colors: NDArray[np.float32]
    gray: Array
    mean: Array
    variance: Array


@lru_cache(maxsize=2)
def still_surface(dataset: Dataset) -> Surface | None:
    """The surfaces that the training cameras of a rig see, a point a pixel; None where cameras move, where there are
    fewer than three, or where nothing states how deep they see. Raises InputError where an image cannot be read."""
    if dataset.depths is None or not dataset.still_cameras or len(dataset.cameras) < 3:
        return None
    stills = _stills(dataset)
    near, far = dataset.depths
    planes = np.linspace(1 / far, 1 / near, DEPTHS)
    maps = [_sweep(still, _nearest(still, stills), planes) for still in stills]
    points, colors, point_count, pixel_count = [], [], 0, 0
    for i, (still, inverse) in enumerate(zip(stills, maps, strict=True)):
        places = _places(still.camera, 1 / inverse.ravel())
        agreeing = sum(
            _agrees(places, other.camera, of_other, NEAR * (planes[1] - planes[0]))
            for j, (other, of_other) in enumerate(zip(stills, maps, strict=True))
            if j != i
        )
        kept = np.isfinite(inverse.ravel()) & (agreeing >= CONFIRMED)
        points.append(places[kept].astype(np.float32))
        colors.append(still.colors.reshape(-1, 3)[kept])
        point_count, pixel_count = point_count + int(kept.sum()), pixel_count + kept.size
    return Surface(np.concatenate(points), np.concatenate(colors), point_count / pixel_count)


def _stills(dataset: Dataset) -> list[_Still]:
    stills = []
    for camera in evenly(dataset.cameras, CAMERAS):
        views = sorted((view for view in dataset.train if view.camera is camera), key=lambda view: view.time)
        small = small_views(evenly(views, IMAGES), SIDE)
        colors = (np.median([view.load()[..., :3] for view in small], axis=0) / 255).astype(np.float32)
        gray = colors.mean(axis=2, dtype=np.float64)
        mean = _box(gray)
        stills.append(_Still(small[0].camera, colors, gray, mean, _box(gray**2) - mean**2))
    return stills


def _nearest(still: _Still, stills: list[_Still]) -> list[_Still]:
    def distance(other: _Still) -> float:
        return float(np.linalg.norm(other.camera.position - still.camera.position))

    return sorted((other for other in stills if other is not still), key=distance)[:NEIGHBOURS]


def _sweep(still: _Still, others: list[_Still], planes: Array) -> Array:
    """(H, W) the inverse depth at which the better half of the other cameras sees the same; NaN where none does."""
    scores = np.stack([_likeness(still, others, plane) for plane in planes])
    best = scores.argmax(axis=0)[None]
    score = np.take_along_axis(scores, best, 0)
    before, after = (np.take_along_axis(scores, (best + k).clip(0, len(planes) - 1), 0) for k in (-1, 1))
    bend = before - 2 * score + after
    between = (bend < 0) & (best > 0) & (best < len(planes) - 1)
    shift = np.where(between, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0).clip(-0.5, 0.5)
    inverse = planes[best] + shift * (planes[1] - planes[0])
    return np.where(score >= MIN_CORRELATION, inverse, np.nan)[0]


def _likeness(still: _Still, others: list[_Still], plane: float) -> Array:
    """(H, W) mean normalized cross-correlation with the better half of the others at this inverse depth; -1 where
    fewer than two see it."""
    height, width = still.gray.shape
    places = _places(still.camera, np.full(height * width, 1 / plane))
    correlations = []
    for other in others:
        x, y, inside = _pixels(places, other.camera)
        at = np.stack([y, x]).reshape(2, height, width) - 0.5
        there = ndimage.map_coordinates(other.gray, at, order=1, mode="nearest")
        its_mean = _box(there)
        both = still.variance * (_box(there**2) - its_mean**2)
        likeness = (_box(still.gray * there) - still.mean * its_mean) / np.sqrt(np.maximum(both, FLAT))
        correlations.append(np.where(inside.reshape(height, width), likeness, np.nan))
    ordered = np.sort(correlations, axis=0)  # NaN last
    seeing = np.isfinite(ordered).sum(axis=0)
    taken = np.maximum(2, (seeing + 1) // 2)
    sums = np.concatenate([np.zeros((1, height, width)), np.cumsum(np.nan_to_num(ordered), axis=0)])
    all_of, worse = (np.take_along_axis(sums, k[None], 0)[0] for k in (seeing, np.maximum(seeing - taken, 0)))
    return np.where(seeing >= 2, (all_of - worse) / taken, -1.0)


def _box(image: Array) -> Array:
    return ndimage.uniform_filter(image, WINDOW, mode="nearest")


def _places(camera: Camera, depths: Array) -> Array:
    """(H W, 3) the points at these depths (H W,) of the middles of the pixels, world units."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.linalg.solve(camera.K, np.stack([x.ravel(), y.ravel(), np.ones(x.size)]))
    return (rays * depths - camera.T_cam_world[:3, 3:]).T @ camera.T_cam_world[:3, :3]


def _pixels(places: Array, camera: Camera) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Where points (N, 3) are in a camera's image, x and y (N,) in pixels, and whether they are inside it."""
    pixels, depths = camera.project(places)
    x, y = pixels.T
    inside = (depths > 1e-9) & (x >= 0.5) & (y >= 0.5) & (x <= camera.width - 0.5) & (y <= camera.height - 0.5)
    return np.where(inside, x, 0.5), np.where(inside, y, 0.5), inside


def _agrees(places: Array, camera: Camera, inverse: Array, most: float) -> NDArray[np.bool_]:
    """(N,) whether a camera's inverse depths (H, W) are those of the points."""
    x, y, inside = _pixels(places, camera)
    of_camera = inverse[y.astype(np.int64), x.astype(np.int64)]
    depths = places @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return inside & (np.abs(of_camera - 1 / depths) < most)
