"""Measures of a capture's images: blur, and changes of the exposure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import in_view
from lapgs_wgpu.prepare.measure import Floats, Look, Measure, distinct_cameras, gray
from lapgs_wgpu.splat.camera import Camera

BLUR = 0.45  # Crete et al.'s measure, of images of 320 pixels
STOPS = 0.3  # of exposure, between the darkest and the brightest images
POINTS_SEEN = 30  # in an image whose exposure is measured


def blur_measure(looks: Sequence[Look]) -> Measure:
    values = [blur(gray(look.image)) for look in looks]
    middle = float(np.median(values))
    worst = looks[int(np.argmax(values))]
    return Measure(
        "blur",
        middle,
        f"{middle:.2f} on a scale from 0 to 1, at most {max(values):.2f} ({Path(worst.view.source).name})",
        f"{BLUR:g} or less",
        middle <= BLUR,
        "move more slowly, use more light or a shorter exposure, and lock the focus",
    )


def blur(gray: NDArray[np.floating]) -> float:
    """How blurred an image (h, w) is, 0 to 1: what another blur takes from the differences of neighbouring pixels.
    Crete, Dolmiere, Ladret, Nicolas, "The blur effect", 2007. A flat image counts as 1."""
    from scipy.ndimage import uniform_filter1d  # slow to import

    found = []
    for axis in (0, 1):
        before = np.abs(np.diff(gray, axis=axis))
        after = np.abs(np.diff(uniform_filter1d(gray, 9, axis=axis), axis=axis))
        total = float(before.sum())
        found.append(1 - float(np.maximum(before - after, 0).sum()) / total if total > 0 else 1.0)
    return max(found)


def exposure(looks: Sequence[Look], points: Floats | None, still: bool) -> Measure:
    """How the same places change in brightness: stops between the images, 5 to 95 % of them."""
    name, threshold = "exposure", f"{STOPS:g} stops or less"
    if points is None and not still:
        why = "not known without a cloud of points, by which the same places are found in several images"
        return Measure(name, float("nan"), "not measured", threshold, None, why)
    if still:
        points = None
    brightness = []
    for look in looks:
        stops = np.log2(np.maximum((gray(look.image) / 255) ** 2.2, 1e-3))
        if points is None:
            brightness.append(stops[::8, ::8].ravel())
        else:
            _, seen = in_view(points, look.view.camera)
            column, row = _pixels(points, look.view.camera, seen)
            values = np.full(len(points), np.nan)
            values[seen] = stops[row, column]
            brightness.append(values)
    table = np.stack(brightness)
    cameras = distinct_cameras([look.view for look in looks])
    groups = [np.array([look.view.camera is camera for look in looks]) for camera in cameras]
    gains = np.full(len(looks), np.nan)
    with np.errstate(all="ignore"):
        for rows in groups if points is None else [np.ones(len(looks), bool)]:
            own = table[rows]
            relative = own - _nanmedian(own, 0)
            enough = np.isfinite(relative).sum(axis=1) >= POINTS_SEEN
            gains[rows] = np.where(enough, _nanmedian(relative, 1), np.nan)
    known = gains[np.isfinite(gains)]
    if len(known) < 3:
        why = f"less than 3 images show {POINTS_SEEN} points of the cloud"
        return Measure(name, float("nan"), "not measured", threshold, None, why)
    low, high = np.percentile(known, [5, 95])
    span = float(high - low)
    return Measure(
        name,
        span,
        f"changes by {span:.2f} stops between dark and bright images",
        threshold,
        span <= STOPS,
        "lock exposure and white balance; or train with --exposure.enabled true, which corrects each image's colors",
    )


def _nanmedian(values: Floats, axis: int) -> Floats:
    """np.nanmedian without its warning about rows of NaN."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        result: Floats = np.nanmedian(values, axis=axis)
    return result


def _pixels(points: Floats, camera: Camera, seen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Column and row of the pixels that show points."""
    pixels, _ = camera.project(points[seen])
    most = [camera.width - 1, camera.height - 1]
    column, row = np.clip(np.floor(pixels).astype(np.int64), 0, most).T
    return column, row
