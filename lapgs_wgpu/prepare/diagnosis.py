"""What a capture is worth: a number for each property that decides, its threshold, and what to film differently."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data import Dataset, View, load_dataset
from lapgs_wgpu.data.cloud import in_view, points_in_view
from lapgs_wgpu.data.images import Pixels, check_image, decode
from lapgs_wgpu.data.readers.colmap import IMAGES
from lapgs_wgpu.data.validation import GAP, GAP_FACTOR
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.camera import Camera

from .masks import MASKS, Mask

Floats = NDArray[np.float64]

SIZE = 320  # longer side of the images that are looked at, pixels
MOST_VIEWS = 96  # of a capture that are looked at, evenly chosen over the clip
MOST_POINTS, MOST_CAMERAS = 1500, 48  # between which angles are measured
PARALLAX = 5.0  # degrees; half a pixel of a phone's image is then 1 % of the depth
SPAN = 20.0  # degrees around what moves
CAMERAS = 3.0  # that see what moves at one moment
LITTLE, MUCH = 0.01, 0.5  # share of the images that moves
CUT = 0.3  # share of the images in which what moves reaches the image's edge
BLUR = 0.45  # Crete et al.'s measure, of images of SIZE pixels
STOPS = 0.3  # of exposure, between the darkest and the brightest images
LEVELS = 16.0  # of 255 from the median over the clip: the pixel of a still camera moves
SEEN = 0.002  # share of an image that moves, from which on it shows something that does
POINTS_SEEN = 30  # in an image whose exposure is measured


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


@dataclass(frozen=True, eq=False)
class Look:
    """A view that was looked at. image: (h, w, 3) RGB. mask: (h', w') of what moves, None where there is none."""

    view: View
    image: Pixels
    mask: Mask | None


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """dataset: images of SIZE pixels. still: the cameras stand still. looks: by camera, then time."""

    folder: Path
    dataset: Dataset
    still: bool
    measures: tuple[Measure, ...]
    looks: tuple[Look, ...]

    def measure(self, name: str) -> Measure:
        return next(each for each in self.measures if each.name == name)

    def __str__(self) -> str:
        views = (*self.dataset.train, *self.dataset.test)
        layout = f"{len(_cameras(views))} cameras that stand still" if self.still else "a camera that moves"
        lines = [f"{self.folder}: {len(views)} images, {layout}", *map(str, self.measures)]
        return "\n".join([*lines, *(f" note  {warning}" for warning in self.dataset.warnings)])


def diagnose(folder: Path) -> Diagnosis:
    """Measure a capture of any format. Raises InputError where it cannot be opened."""
    dataset = load_dataset(folder, image_size=SIZE)
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.time)
    cameras = _cameras(views)
    still = len(views) >= 2 * len(cameras)
    looks = _looks(folder, views, cameras if still else None)
    points = _points(dataset)
    measures = [
        _parallax(cameras, points),
        *_motion(looks, still, cameras, points),
        _blur(looks),
        _exposure(looks, points if dataset.cloud is not None else None, still),
        _gaps(np.unique([view.time for view in views])),
    ]
    return Diagnosis(folder, dataset, still, tuple(measures), tuple(looks))


def _cameras(views: Sequence[View]) -> list[Camera]:
    return list({id(view.camera): view.camera for view in views}.values())


def _looks(folder: Path, views: Sequence[View], cameras: Sequence[Camera] | None) -> list[Look]:
    """The images of some views by time, with masks. cameras: those that stand still; then all show the same moments."""
    if cameras is None:
        chosen = [views[i] for i in _evenly(len(views), MOST_VIEWS)]
    else:
        each = [[view for view in views if view.camera is camera] for camera in cameras]
        moments = max(3, MOST_VIEWS // len(cameras))
        chosen = [own[i] for own in each for i in _evenly(len(own), moments)]
    with ThreadPoolExecutor(4) as pool, Progress(len(chosen), "images looked at") as progress:
        images = []
        for image in pool.map(lambda view: view.load()[..., :3], chosen):
            images.append(image)
            progress.step()
    if cameras is None:
        masks = [_mask(folder, view) for view in chosen]
    else:
        masks = []
        for camera in cameras:
            gray = np.stack([_gray(i) for i, view in zip(images, chosen, strict=True) if view.camera is camera])
            masks += list(np.abs(gray - np.median(gray, axis=0)) > LEVELS)
    return [Look(*each) for each in zip(chosen, images, masks, strict=True)]


def _evenly(count: int, most: int) -> list[int]:
    return sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()))


def _mask(folder: Path, view: View) -> Mask | None:
    """The mask that lapgs-prepare wrote for the image of a view."""
    try:
        name = PurePosixPath(Path(os.path.relpath(view.source, folder / IMAGES)).as_posix())
    except ValueError:  # of another drive
        return None
    path = folder / MASKS / name.with_suffix(".png")
    if not path.is_file():
        return None
    check_image(path, whole=False)
    return decode(path)[..., 0] >= 128


def _points(dataset: Dataset) -> Floats:
    """(N, 3) points of the scene: of its cloud, else random ones where views overlap, else what cameras look at."""
    random = np.random.default_rng(0)
    if dataset.cloud is not None:
        points = dataset.cloud.points
        return points[random.permutation(len(points))[:MOST_POINTS]].astype(np.float64)
    if dataset.depths is not None:
        return points_in_view(dataset.cameras, *dataset.depths, MOST_POINTS, 0).astype(np.float64)
    return dataset.focus[None]


def _parallax(cameras: Sequence[Camera], points: Floats) -> Measure:
    """The largest angle between two cameras that see a point, the median over the points."""
    chosen = [cameras[i] for i in _evenly(len(cameras), MOST_CAMERAS)]
    seen = np.stack([in_view(points, camera)[1] for camera in chosen])
    away = points - np.stack([camera.position for camera in chosen])[:, None]
    rays = np.where(seen[..., None], away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-12), np.nan)
    least = np.full(len(points), 1.0)
    for ray in rays:
        cosines = np.einsum("cni,ni->cn", rays, ray)
        least = np.fmin(least, np.fmin.reduce(cosines, axis=0))
    several = seen.sum(axis=0) > 1
    degrees = float(np.median(np.degrees(np.arccos(np.clip(least[several], -1, 1))))) if several.any() else 0.0
    return Measure(
        "parallax",
        degrees,
        f"{degrees:.1f} degrees between the two cameras furthest apart that see a point",
        f"{PARALLAX:g} or more",
        degrees >= PARALLAX,
        "walk around what moves instead of turning on the spot, or put the cameras further apart: depth is a guess",
    )


def _motion(looks: Sequence[Look], still: bool, cameras: Sequence[Camera], points: Floats) -> list[Measure]:
    """Share of the images that moves; coverage of what moves; how often it is cut off."""
    masks = [look.mask for look in looks if look.mask is not None]
    share = float(np.mean([mask.mean() for mask in masks])) if masks else float("nan")
    unknown = "not known without masks of what moves, which lapgs-prepare makes of films"
    moves = Measure(
        "moving share",
        share,
        f"{share:.1%} of the image area moves" if masks else "not measured",
        f"{LITTLE:.0%} to {MUCH:.0%}",
        LITTLE <= share <= MUCH if masks else None,
        unknown
        if not masks
        else "film longer, or closer, or train with --field static: hardly anything moves"
        if share < LITTLE
        else "leave more of what stands still in the picture, since the cameras are placed by that",
    )
    found = [moves, _coverage_of_still(looks) if still else _coverage_of_moving(cameras, points)]
    showing = [mask for mask in masks if mask.mean() > SEEN]
    cut = float(np.mean([_touches_edge(mask) for mask in showing])) if showing else float("nan")
    cut_off = Measure(
        "cut off",
        cut,
        f"in {cut:.0%} of the images what moves reaches the image's edge" if showing else "not measured",
        f"{CUT:.0%} or less",
        cut <= CUT if showing else None,
        "keep what moves inside the picture, with room around it"
        if showing
        else unknown
        if not masks
        else "it is still",
    )
    return [*found, cut_off]


def _coverage_of_still(looks: Sequence[Look]) -> Measure:
    """Of cameras that stand still: how many see something move at one moment."""
    moments: dict[float, int] = {}
    for look in looks:
        shows = look.mask is not None and look.mask.mean() > SEEN
        moments[round(look.view.time, 6)] = moments.get(round(look.view.time, 6), 0) + shows
    moving = [count for count in moments.values() if count]
    cameras = float(np.median(moving)) if moving else 0.0
    return Measure(
        "coverage",
        cameras,
        f"{cameras:g} cameras see something move at one moment",
        f"{CAMERAS:g} or more",
        cameras >= CAMERAS,
        "aim more cameras at what moves: where less than three see it, its place in depth is a guess",
    )


def _coverage_of_moving(cameras: Sequence[Camera], points: Floats) -> Measure:
    """Of a camera that moves: the angle that it goes around the middle of the scene."""
    away = np.stack([camera.position for camera in cameras]) - np.median(points, axis=0)
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    degrees = float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1, 1))))
    return Measure(
        "coverage",
        degrees,
        f"the camera goes {degrees:.0f} degrees around the scene",
        f"{SPAN:g} or more",
        degrees >= SPAN,
        "walk further around what moves: its other sides stay empty, and few views of each side tell its depth",
    )


def _touches_edge(mask: Mask) -> bool:
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(edge.mean() > 0.01)


def _blur(looks: Sequence[Look]) -> Measure:
    values = [blur(_gray(look.image)) for look in looks]
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


def _exposure(looks: Sequence[Look], points: Floats | None, still: bool) -> Measure:
    """How the same places change in brightness: stops between the images, 5 to 95 % of them."""
    name, threshold = "exposure", f"{STOPS:g} stops or less"
    if points is None and not still:
        why = "not known without a cloud of points, by which the same places are found in several images"
        return Measure(name, float("nan"), "not measured", threshold, None, why)
    if still:
        points = None
    brightness = []
    for look in looks:
        stops = np.log2(np.maximum((_gray(look.image) / 255) ** 2.2, 1e-3))
        if points is None:
            brightness.append(stops[::8, ::8].ravel())
        else:
            _, seen = in_view(points, look.view.camera)
            column, row = _pixels(points, look.view.camera, seen)
            values = np.full(len(points), np.nan)
            values[seen] = stops[row, column]
            brightness.append(values)
    table = np.stack(brightness)
    groups = [np.array([look.view.camera is camera for look in looks]) for camera in _cameras([x.view for x in looks])]
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
    local = points[seen] @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    place = local @ camera.K.T
    place = place[:, :2] / place[:, 2:]
    most = [camera.width - 1, camera.height - 1]
    column, row = np.clip(np.floor(place).astype(np.int64), 0, most).T
    return column, row


def _gaps(times: Floats) -> Measure:
    """The longest time without an image."""
    steps = np.diff(times)
    if not len(steps):
        raise InputError("all images have the same time, so nothing can move; film for a few seconds.")
    longest, usual = float(steps.max()), float(np.median(steps))
    at = float(times[int(np.argmax(steps))])
    return Measure(
        "time gaps",
        longest,
        f"{longest:.1%} of the clip without an image, {longest / usual:.1f} usual steps, from {at:.0%} on",
        f"{GAP:.0%} or less, or {GAP_FACTOR:g} usual steps",
        longest <= GAP or longest <= GAP_FACTOR * usual,
        "film without pauses and move slowly there: images were blurred, repeated, or could not be placed",
    )


def _gray(image: Pixels) -> NDArray[np.float32]:
    """Gray levels (h, w), 0 to 255, of RGB."""
    return (image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)).astype(np.float32)
