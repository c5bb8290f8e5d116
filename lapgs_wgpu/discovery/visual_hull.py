"""Points of what moves between cameras that stand all around: the visual hull of what differs from their medians.

Something is at a place if nearly all cameras that see the place, AROUND or more, show what they usually do not. Source:
Laurentini, The visual hull concept for silhouette-based image understanding (PAMI 1994).
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lapgs_wgpu.data.evenly import evenly, evenly_indices
from lapgs_wgpu.data.plane_sweep import IMAGES
from lapgs_wgpu.data.views import AROUND, Dataset, View, composite, small_views
from lapgs_wgpu.discovery.residual import Mask, cubic_grid
from lapgs_wgpu.discovery.surface_points import PointClouds, Points
from lapgs_wgpu.progress import counted

SIDE = 160  # pixels, of the images that are compared
CELLS = 96  # along each axis of the cube
DIFFERENT = 20.0  # levels of 255; mean of channels and neighboring pixels, from which on a pixel differs
WHOLE = 0.5  # share of an image, above which not what moves differs, but its exposure
AGREEING = 0.9  # share of the cameras that see a place, in which it differs
POINTS = 1500  # of a time, at most
TINT = 1.0  # `PointClouds.tint`, in half sides: hands that hold a ball are not of one color with it
BLACK = 0.0, 0.0, 0.0


def hull_points(dataset: Dataset, half_side: float) -> PointClouds:
    """Points of what moves within [-half_side, half_side]^3, for each time of a rig's clip. Raises InputError where an
    image cannot be read."""
    places = cubic_grid((np.arange(CELLS) + 0.5) / CELLS * 2 * half_side - half_side)
    cameras = [
        _still_camera([view for view in dataset.train if view.camera is camera], places) for camera in dataset.cameras
    ]
    clouds = []
    for time in counted(dataset.times, len(dataset.times), "times searched for what moves"):
        seeing, agreeing = np.zeros((2, len(places)), np.int32)
        shown = []
        for views, usual, pixel in cameras:
            if (view := views.get(float(time))) is None:
                continue
            image = composite(view.load(), BLACK)
            differs = ndimage.uniform_filter(np.abs(image - usual).mean(axis=2), 3) > DIFFERENT
            if differs.mean() > WHOLE:
                continue
            shown.append((image, differs, pixel))
            seeing += pixel >= 0
            agreeing += _at(ndimage.binary_dilation(differs), pixel)
        there = np.flatnonzero((seeing >= AROUND) & (agreeing >= AGREEING * seeing))
        there = there[evenly_indices(len(there), POINTS)]
        colors = np.full((len(shown), len(there), 3), np.nan, np.float32)
        for color, (image, differs, pixel) in zip(colors, shown, strict=True):
            shows = _at(differs, pixel[there])
            color[shows] = image.reshape(-1, 3)[pixel[there[shows]]] / 255
        known = np.isfinite(colors).any(axis=(0, 2))
        color = np.nanmedian(colors[:, known], axis=0)  # in some cameras something else is before it
        clouds.append(Points(places[there[known]].astype(np.float32), color, np.ones(len(color), np.float32)))
    return PointClouds(dataset.times, tuple(clouds), half_side, TINT * half_side)


def _still_camera(
    views: list[View], places: NDArray[np.float32]
) -> tuple[dict[float, View], NDArray[np.float32], NDArray[np.int32]]:
    """Small views, by time; their usual image (h, w, 3); and the pixel (n,) that shows each place, -1 where none."""
    small = sorted(small_views(views, SIDE), key=lambda view: view.time)
    usual = np.median([composite(view.load(), BLACK) for view in evenly(small, IMAGES)], axis=0).astype(np.float32)
    camera = small[0].camera
    pixels, depths = camera.project(places)
    inside = (depths > 1e-9) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    column, row = np.where(inside[:, None], pixels, 0).astype(np.int32).T
    return {view.time: view for view in small}, usual, np.where(inside, row * camera.width + column, -1)


def _at(mask: Mask, pixel: NDArray[np.int32]) -> Mask:
    """(n,) the mask at pixels (n,), False where these are -1."""
    return np.append(mask.ravel(), False)[pixel]
