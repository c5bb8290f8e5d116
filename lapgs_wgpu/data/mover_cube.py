"""The cube in which things move, from masks and a cloud of what stands still: the field's cells belong there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import Cloud, in_view
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.data.normalize import Cube
from lapgs_wgpu.splat.camera import Camera

IMAGES = 32  # that are looked at, evenly over the clip
BESIDE, ABOVE, BELOW = 0.5, 0.1, 0.3  # parts of a mover's width and height: around its foot, where the ground is
NEAREST = 25  # per cent of the points around a mover that lie no further than it does, where none are at its foot
LEAST = 3  # points
MEDIAN = 5  # images over which depths are compared
ROOM = 1.1  # of the cube, relative to what moves


def mover_cube(cloud: Cloud, seen: Sequence[tuple[Camera, Callable[[], Mask]]]) -> Cube | None:
    """The cube of what moves over the clip, in the cloud's coordinates; None where nothing does or no depth is known.

    seen: the camera of each image, by time, and what decodes its mask (H, W).
    """
    from scipy import ndimage  # slow to import

    points = cloud.points.astype(np.float64)
    boxes = [found for camera, mask in evenly(seen, IMAGES) if (found := _box(camera, mask(), points)) is not None]
    if not boxes:
        return None
    depths = ndimage.median_filter(np.array([box.depth for box in boxes]), MEDIAN, mode="nearest")
    corners = []
    for box, depth in zip(boxes, depths, strict=True):
        camera = box.camera
        rays = np.linalg.solve(camera.K, np.array([[x, y, 1.0] for x in box.sides for y in box.ends]).T)
        corners.append((depth * rays - camera.T_cam_world[:3, 3:]).T @ camera.T_cam_world[:3, :3])
    low, high = np.min(np.concatenate(corners), axis=0), np.max(np.concatenate(corners), axis=0)
    return Cube((low + high) / 2, float(max(ROOM * (high - low).max() / 2, 1e-6)))


class _Box(NamedTuple):
    """What moves in the image of a camera. sides, ends: left and right, top and bottom, pixels."""

    camera: Camera
    sides: tuple[float, float]
    ends: tuple[float, float]
    depth: float


def _box(camera: Camera, mask: Mask, points: NDArray[np.float64]) -> _Box | None:
    """The largest thing that moves in an image; None where nothing does, or no point tells its depth."""
    from scipy import ndimage  # slow to import

    labels, count = ndimage.label(mask)
    if not count:
        return None
    rows, columns = np.nonzero(labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]))
    left, right, top, bottom = (float(v) for v in (columns.min(), columns.max() + 1, rows.min(), rows.max() + 1))
    width, height = right - left, bottom - top
    depth, inside = in_view(points, camera)
    x, y = camera.project(points[inside])[0].T
    depth = depth[inside]
    free = ~mask[y.astype(np.int64), x.astype(np.int64)]
    beside = free & (x > left - BESIDE * width) & (x < right + BESIDE * width)
    foot = beside & (y > bottom - ABOVE * height) & (y < bottom + BELOW * height)
    around = beside & (y > top - BESIDE * height) & (y < bottom + BESIDE * height)
    if around.sum() < LEAST:
        return None
    found = float(np.percentile(depth[around], NEAREST))
    foot &= depth < np.median(depth[around])  # what a wet road mirrors lies beyond
    if foot.any():
        found = min(found, float(np.median(depth[foot])))
    return _Box(camera, (left, right), (top, bottom), found)
