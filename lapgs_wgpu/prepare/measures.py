"""What a capture is worth, property by property: a number, its threshold, and what to film differently."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data import View
from lapgs_wgpu.data.cloud import in_view
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import Pixels
from lapgs_wgpu.prepare.masks import Mask
from lapgs_wgpu.splat.camera import Camera

MOST_CAMERAS = 48  # between which angles are measured
LITTLE = 0.01  # share of the images that moves, at least
SEEN = 0.002  # share of an image that moves, from which on it shows something that does
STEP, TURN = 8.0, 8.0  # of a path: largest step and turn over their medians
AROUND = 75.0  # degrees a second, around the middle of the scene, at most
FEWEST_OF_PATH, NAMED = 8, 3  # images whose path is judged; faults that are named
POINTS_SEEN = 30  # in an image whose exposure is measured
ANY = float("inf")

# Least and most, the same as a text, and what to film differently. Half a pixel of a phone's image is 1 % of the depth
# at 5 degrees.
WANTED: dict[str, tuple[float, float, str, str]] = {
    "parallax": (5.0, ANY, "5 or more",
        "walk around what moves instead of turning on the spot, or put the cameras further apart: depth is a guess"),
    "path": (0, 0, f"no step above {STEP:g} and no turn above {TURN:g} times the usual one, no doubling back or stall, "
        f"at most {AROUND:g} degrees a second around the scene",
        "the cameras are likely wrong there: cut the film at these images, or film that part more slowly"),
    "moving share": (LITTLE, 0.5, "1% to 50%",
        "leave more of what stands still in the picture, since the cameras are placed by that"),
    "cameras": (3.0, ANY, "3 or more",
        "aim more cameras at what moves: where less than three see it, its place in depth is a guess"),
    "coverage": (20.0, ANY, "20 or more",
        "walk further around what moves: its other sides stay empty, and few views of each side tell its depth"),
    "blur": (0, 0.45, "0.45 or less",
        "move more slowly, use more light or a shorter exposure, and lock the focus"),
    "exposure": (0, 0.3, "0.3 stops or less",
        "lock exposure and white balance; or train with --exposure.enabled true, which corrects each image's colors"),
}  # fmt: skip

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Measure:
    """One property. number: its value, NaN where it cannot be measured. value, threshold: as texts with units. good:
    None where it cannot be measured. advice: what to film differently, or why there is no number."""

    name: str
    number: float
    value: str
    threshold: str
    good: bool | None
    advice: str

    def __str__(self) -> str:
        mark = {True: "good", False: "POOR", None: "-"}[self.good]
        return f"{mark:>5}  {self.name}: {self.value} (wanted: {self.threshold})" + (
            "" if self.good else f". {self.advice[0].upper()}{self.advice[1:]}."
        )


def measured(wanted: str, number: float, value: str, advice: str = "", name: str = "") -> Measure:
    """A number judged by a row of WANTED; NaN where it cannot be measured, for the reason `advice`."""
    least, most, threshold, usual = WANTED[wanted]
    good = None if np.isnan(number) else bool(least <= number <= most)
    return Measure(name or wanted, float(number), value, threshold, good, advice or usual)


@dataclass(frozen=True, eq=False)
class Look:
    """A view that was looked at. image: (h, w, 3) RGB. mask: (h', w') of what moves, None where there is none."""

    view: View
    image: Pixels
    mask: Mask | None


def distinct_cameras(views: Sequence[View]) -> list[Camera]:
    return list({id(view.camera): view.camera for view in views}.values())


def gray(image: Pixels) -> NDArray[np.float32]:
    """Gray levels (h, w), 0 to 255, of RGB."""
    return (image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)).astype(np.float32)


def parallax(cameras: Sequence[Camera], points: Floats) -> Measure:
    """The largest angle between two cameras that see a point, the median over the points."""
    chosen = evenly(cameras, MOST_CAMERAS)
    seen = np.stack([in_view(points, camera)[1] for camera in chosen])
    away = points - np.stack([camera.position for camera in chosen])[:, None]
    rays = np.where(seen[..., None], away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-12), np.nan)
    least = np.full(len(points), 1.0)
    for ray in rays:
        cosines = np.einsum("cni,ni->cn", rays, ray)
        least = np.fmin(least, np.fmin.reduce(cosines, axis=0))
    several = seen.sum(axis=0) > 1
    degrees = float(np.median(np.degrees(np.arccos(np.clip(least[several], -1, 1))))) if several.any() else 0.0
    text = f"{degrees:.1f} degrees between the two cameras furthest apart that see a point"
    return measured("parallax", degrees, text)


def path_faults(places: Floats, axes: Floats, points: Floats, names: Sequence[str]) -> list[tuple[str, int]]:
    """What a hand-held camera does not do, with the number of the image at which it does.

    places, axes: (n, 3) of the cameras and where they look, in the order of time. points: (N, 3) of the scene. names:
    of the images, which are milliseconds in films. Steps that are small beside the scene's distance are noise, of a
    camera that turns or stands.
    """
    if len(places) < FEWEST_OF_PATH:
        return []
    steps = np.diff(places, axis=0)
    length = np.linalg.norm(steps, axis=1)
    away = float(np.median(np.linalg.norm(points - np.median(places, axis=0), axis=1)))
    usual = max(float(np.median(length)), 1e-3 * away)
    turns = np.degrees(np.arccos(np.clip((axes[1:] * axes[:-1]).sum(axis=1), -1, 1)))
    turn = max(float(np.median(turns)), 0.5)
    cosine = (steps[1:] * steps[:-1]).sum(axis=1) / np.maximum(length[1:] * length[:-1], 1e-12)
    back = (cosine < -0.5) & (np.minimum(length[1:], length[:-1]) > max(usual, 1e-2 * away))
    still = length < 0.02 * float(np.median(length))
    faults = [(f"a step of {length[i] / usual:.0f} times the usual one", i + 1) for i in _above(length, STEP * usual)]
    faults += [(f"a turn of {turns[i]:.0f} degrees", i + 1) for i in _above(turns, TURN * turn)]
    faults += [("the path doubles back", int(i) + 1) for i in np.flatnonzero(back)]
    long = max(3, len(still) // 10)
    stalls = [i for i in range(len(still) - long + 1) if still[i : i + long].all()][:1]
    faults += [("the path stalls", i) for i in stalls]
    stems = [Path(name).stem for name in names]
    if all(len(stem) == 8 and stem.isdecimal() for stem in stems):
        seconds = (int(stems[-1]) - int(stems[0])) / 1000
        around = (places[[0, -1]] - np.median(points, axis=0)) / away
        speed = np.degrees(2 * np.arcsin(min(float(np.linalg.norm(around[1] - around[0])) / 2, 1.0))) / seconds
        faults += [(f"{speed:.0f} degrees a second around the scene", 0)] * bool(speed > AROUND)
    return faults


def _above(values: Floats, limit: float) -> list[int]:
    return [int(i) for i in np.flatnonzero(values > limit)]


def path(views: Sequence[View], points: Floats) -> Measure:
    """Of a camera that moves: whether its path is one that a hand can walk."""
    places = np.stack([view.camera.position for view in views])
    axes = np.stack([view.camera.T_cam_world[2, :3] for view in views])
    faults = path_faults(places, axes, points, [view.source for view in views])
    named = ", ".join(f"{what} at {Path(views[i].source).name}" for what, i in faults[:NAMED])
    more = f" and {len(faults) - NAMED} more" if len(faults) > NAMED else ""
    return measured("path", float(len(faults)), f"{named}{more}" if faults else "smooth")


def moving_share(looks: Sequence[Look]) -> Measure:
    """Share of the images that moves."""
    masks = [look.mask for look in looks if look.mask is not None]
    if not masks:
        why = "no masks of what moves, which lapgs-prepare makes of films"
        return measured("moving share", float("nan"), "not measured", why)
    share = float(np.mean([mask.mean() for mask in masks]))
    still = "film longer, or closer, or train with --field static: hardly anything moves" if share < LITTLE else ""
    return measured("moving share", share, f"{share:.1%} of the image area moves", still)


def coverage_of_still(looks: Sequence[Look]) -> Measure:
    """Of cameras that stand still: how many see something move at one time."""
    counts: dict[float, int] = {}  # of cameras that see something move, by time
    for look in looks:
        time = round(look.view.time, 6)
        counts[time] = counts.get(time, 0) + (look.mask is not None and bool(look.mask.mean() > SEEN))
    moving = [count for count in counts.values() if count]
    cameras = float(np.median(moving)) if moving else 0.0
    return measured("cameras", cameras, f"{cameras:g} cameras see something move at one time", name="coverage")


def coverage_of_moving(cameras: Sequence[Camera], points: Floats) -> Measure:
    """Of a camera that moves: the angle that it goes around the middle of the scene."""
    away = np.stack([camera.position for camera in cameras]) - np.median(points, axis=0)
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    degrees = float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1, 1))))
    return measured("coverage", degrees, f"the camera goes {degrees:.0f} degrees around the scene")


def blur_measure(looks: Sequence[Look]) -> Measure:
    values = [blur(gray(look.image)) for look in looks]
    middle = float(np.median(values))
    worst = looks[int(np.argmax(values))]
    text = f"{middle:.2f} on a scale from 0 to 1, at most {max(values):.2f} ({Path(worst.view.source).name})"
    return measured("blur", middle, text)


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
    """How the same places change in brightness: stops between the images, 5 to 95 % of them.

    A place is a pixel of a camera that stands still, else a point of the cloud.
    """
    nothing = "exposure", float("nan"), "not measured"
    if points is None and not still:
        return measured(*nothing, "no cloud of points, by which the same places are found in other images")
    cameras = distinct_cameras([look.view for look in looks])
    groups = [[look for look in looks if look.view.camera is camera] for camera in cameras] if still else [looks]
    gains = []
    for group in groups:
        stops = np.stack([_stops(look, None if still else points) for look in group])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of places that no image shows
            relative = stops - np.nanmedian(stops, axis=0)
            gains += [np.nanmedian(row) for row in relative if np.isfinite(row).sum() >= POINTS_SEEN]
    if len(gains) < 3:
        return measured(*nothing, f"less than 3 images show {POINTS_SEEN} points of the cloud")
    low, high = np.percentile(gains, [5, 95])
    return measured("exposure", high - low, f"changes by {high - low:.2f} stops between dark and bright images")


def _stops(look: Look, points: Floats | None) -> Floats:
    """Brightness at the points, NaN where they are out of view; without points, of some pixels."""
    stops = np.log2(np.maximum((gray(look.image) / 255) ** 2.2, 1e-3))
    if points is None:
        return stops[::8, ::8].ravel()
    camera = look.view.camera
    _, seen = in_view(points, camera)
    pixels, _ = camera.project(points[seen])
    column, row = np.clip(np.floor(pixels).astype(np.int64), 0, [camera.width - 1, camera.height - 1]).T
    values = np.full(len(points), np.nan)
    values[seen] = stops[row, column]
    return values
