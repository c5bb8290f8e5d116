"""Where the scene of a capture lies: its depths before the cameras, its cube, or that of what moves, from masks and a
cloud of what stands still; and a cloud that is filled up."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import Cloud, in_view, points_at, points_in_view, views_of
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.focus import are_parallel, focus_of
from lapgs_wgpu.data.frames import Capture
from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.data.normalize import BOX, Cube, Normalization, cube_in_view, cube_of_points
from lapgs_wgpu.data.poses import AXES_HINT
from lapgs_wgpu.data.views import View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Array, Camera

CUBE_POINTS = 4096  # random points that determine the cube of a capture without a cloud
MIN_CLOUD_POINTS = 4096  # a smaller cloud is filled up: Gaussians multiply too slowly to fill what it leaves empty
TOO_WIDE = 4.0  # times the cube that the cameras see around their focus: a cloud's cube beyond that is not their scene
NEAR_FACTOR, FAR_FACTOR = 0.25, 2.0  # depths relative to the distance of the focus, for own footage without a cloud
IMAGES = 32  # that are looked at, evenly over the clip
BESIDE, ABOVE, BELOW = 0.5, 0.1, 0.3  # parts of a mover's width and height: around its foot, where the ground is
NEAREST = 25  # per cent of the points around a mover that lie no further than it does, where none are at its foot
LEAST = 3  # points
MEDIAN = 5  # images over which depths are compared
ROOM = 1.1  # of the cube, relative to what moves


def place(
    capture: Capture, cameras: Sequence[Camera], cube: Cube | None, warnings: list[str]
) -> tuple[Normalization | None, Cloud | None, tuple[float, float] | None]:
    """Determine the cube that a capture fills. Returns the transform to the world's coordinates, None where the
    capture's are kept, and cloud and depths in the world's.

    cameras: the distinct training cameras, in the capture's coordinates. cube: that of what moves, in these, too;
    None for that of the whole scene. Appends warnings. Raises InputError where nothing tells where the scene is.
    """
    depths = _depths(capture, cameras, warnings)
    cube = cube or _cube(capture, cameras, depths)
    if cube is None:
        warnings.append(
            f"{capture.source}: half or more of {len(cameras)} cameras look away from the point nearest to all "
            "optical axes, so the size of the scene is unknown and it keeps its coordinates: if that is not "
            f"[-{BOX:g}, {BOX:g}]^3, raise points.box and field.bound, or add a cloud (fused.ply)."
        )
    cloud = capture.cloud
    if cloud is not None and capture.own_footage:
        cloud = _filled(cloud, cameras)
    if cube is None or (capture.keeps_coordinates and cube.fits):
        return None, cloud and Cloud(cloud.points.astype(np.float32), cloud.colors), depths
    fit = Normalization(cube.center, BOX / cube.half)
    return fit, cloud and fit.cloud(cloud), depths and (depths[0] * fit.scale, depths[1] * fit.scale)


def _depths(capture: Capture, cameras: Sequence[Camera], warnings: list[str]) -> tuple[float, float] | None:
    """Return nearest and furthest depth if stated, or if no cloud replaces them. Appends a warning of a guess."""
    stated = [frame.depths for frame in capture.frames if frame.split == "train" and frame.depths is not None]
    if stated:
        return min(near for near, _ in stated), float(np.median([far for _, far in stated]))
    if capture.cloud is not None or capture.keeps_coordinates:
        return None
    focus = focus_of(cameras, origin=False)
    depth = np.array([(camera.T_cam_world @ [*focus, 1.0])[2] for camera in cameras])
    behind = int((depth <= 0).sum())
    if 2 * behind > len(cameras):
        raise InputError(
            f"{capture.source}: there is no cloud, and {behind} of {len(cameras)} cameras look away from the point "
            f"nearest to all optical axes: {AXES_HINT}, or give a cloud."
        )
    near, far = NEAR_FACTOR * float(depth[depth > 0].min()), FAR_FACTOR * float(depth.max())
    if are_parallel(cameras):
        warnings.append(
            f"{capture.source}: there is no cloud, and all cameras look in one direction: that the scene is "
            f"{near:.3g} to {far:.3g} away, in its units, is a guess; walk around what moves, or give a cloud."
        )
    return near, far


def _cube(capture: Capture, cameras: Sequence[Camera], depths: tuple[float, float] | None) -> Cube | None:
    """Return the cube that the capture fills, in its own coordinates; None if neither files nor cameras tell.

    Of a cloud, it is that of the points that at least two cameras see; of a scan that reaches far beyond what the
    cameras look at, and is seen there, too, that of the points near their focus.
    """
    if capture.cloud is None:
        return cube_of_points(points_in_view(cameras, *depths, CUBE_POINTS, 0)) if depths else cube_in_view(cameras)
    points = capture.cloud.points.astype(np.float64)
    twice = views_of(points, cameras) >= min(2, len(cameras))
    cube, viewed = cube_of_points(points[twice] if twice.any() else points), cube_in_view(cameras)
    if viewed is None or cube.half <= TOO_WIDE * viewed.half:
        return cube
    near = near_focus(points, cameras)
    return cube_of_points(points[near]) if near.any() else cube


def near_focus(points: Array, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """(N,) which points (N, 3) are near the cameras' focus, and seen by half as many cameras as that most see or more;
    none where the cameras have no focus."""
    viewed = cube_in_view(cameras)
    if viewed is None:
        return np.zeros(len(points), bool)
    near = np.abs(points - viewed.center).max(axis=1) <= TOO_WIDE * viewed.half
    seen = views_of(points, cameras)
    return near & (2 * seen >= max(seen.max(where=near, initial=0), 1))


def _filled(cloud: Cloud, cameras: Sequence[Camera]) -> Cloud:
    """Fill up a cloud to MIN_CLOUD_POINTS points.

    The new points are random where views overlap, between the depths of the cloud, in the color of the nearest one.
    """
    from scipy.spatial import cKDTree  # slow to import

    missing = MIN_CLOUD_POINTS - len(cloud.points)
    if missing <= 0:
        return cloud
    points = cloud.points.astype(np.float64)
    depths = np.concatenate([points @ c.T_cam_world[2, :3] + c.T_cam_world[2, 3] for c in cameras])
    near, far = np.percentile(depths[depths > 0], [1, 99])
    added = points_in_view(cameras, float(near), float(far) * 1.01, missing, 0)
    _, nearest = cKDTree(points).query(added)
    return Cloud(
        np.concatenate([cloud.points, added.astype(cloud.points.dtype)]),
        np.concatenate([cloud.colors, cloud.colors[nearest]]),
    )


# The cube of what moves


def mover_cube(cloud: Cloud, views: Sequence[View]) -> Cube | None:
    """The cube of what moves in views, in the cloud's coordinates; None where nothing does or no depth is known."""
    from scipy import ndimage  # slow to import

    points, by_time = cloud.points.astype(np.float64), sorted(views, key=lambda view: view.time)
    seen = [(view.camera, view.moving) for view in by_time if view.moving is not None]
    boxes = [(camera, box) for camera, mask in evenly(seen, IMAGES) if (box := _box(camera, mask(), points))]
    if not boxes:
        return None
    depths = ndimage.median_filter(np.array([depth for _, (_, depth) in boxes]), MEDIAN, mode="nearest")
    at = [points_at(camera, box, np.full(4, depth)) for (camera, (box, _)), depth in zip(boxes, depths, strict=True)]
    low, high = np.concatenate(at).min(axis=0), np.concatenate(at).max(axis=0)
    return Cube((low + high) / 2, float(max(ROOM * (high - low).max() / 2, 1e-6)))


def _box(camera: Camera, mask: Mask, points: NDArray[np.float64]) -> tuple[Array, float] | None:
    """The corners (4, 2), pixels, of the largest thing that moves in an image, and its depth; None where nothing does,
    or no point tells the depth."""
    from scipy import ndimage  # slow to import

    labels, count = ndimage.label(mask)
    if not count:
        return None
    rows, columns = ndimage.find_objects(labels)[np.bincount(labels.ravel())[1:].argmax()]
    left, right, top, bottom = (float(v) for v in (columns.start, columns.stop, rows.start, rows.stop))
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
    return np.array([[left, top], [left, bottom], [right, top], [right, bottom]]), found
