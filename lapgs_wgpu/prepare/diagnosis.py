"""What a capture is worth: a number for each property that decides, what is wanted, and what to film differently."""

import math
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data import Dataset, View, load_dataset
from lapgs_wgpu.data.cloud import in_view, points_in_view
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.focus import FAR_APART, degrees_apart
from lapgs_wgpu.data.images import Pixels
from lapgs_wgpu.data.masks import Mask, decode_mask
from lapgs_wgpu.data.readers.colmap import IMAGES
from lapgs_wgpu.prepare.poses import Floats
from lapgs_wgpu.prepare.search import AROUND, STEP, TURN, path_faults
from lapgs_wgpu.progress import counted
from lapgs_wgpu.splat.camera import Camera

MASKS = "masks"  # folder of a capture
SIZE = 320  # longer side of the images that are looked at, pixels
MOST_VIEWS = 96  # of a capture that are looked at, evenly chosen over the clip
MOST_POINTS, MOST_CAMERAS = 1500, 48  # at which, and between which, angles are measured
LITTLE = 0.01  # share of the images that moves, at least
SEEN = 0.002  # share of an image that moves, from which on it shows something that does
POINTS_SEEN = 30  # in an image whose exposure is measured
NAMED = 3  # faults of a path


class Measure(NamedTuple):
    """One property. least, most: of a good one. wanted: these as a text. advice: what to film differently, or why there
    is no number. number: NaN where it cannot be measured. value: the same as a text with units."""

    name: str
    least: float
    most: float
    wanted: str
    advice: str
    number: float = math.nan
    value: str = "not measured"

    @property
    def good(self) -> bool | None:
        """None where it cannot be measured."""
        return None if math.isnan(self.number) else self.least <= self.number <= self.most

    def __str__(self) -> str:
        mark = {True: "good", False: "POOR", None: "-"}[self.good]
        text = f"{mark:>5}  {self.name}: {self.value} (wanted: {self.wanted})"
        return text if self.good else f"{text}. {self.advice[0].upper()}{self.advice[1:]}."


class Look(NamedTuple):
    """A view that was looked at. image: (h, w, 3) RGB. mask: (h', w') of what moves, None where there is none."""

    view: View
    image: Pixels
    mask: Mask | None


class Diagnosis(NamedTuple):
    """dataset: images of SIZE pixels. still: the cameras stand still. looks: by camera, then time."""

    dataset: Dataset
    still: bool
    measures: list[Measure]
    looks: list[Look]

    def measure(self, name: str) -> Measure | None:
        return next((each for each in self.measures if each.name == name), None)

    def __str__(self) -> str:
        views = (*self.dataset.train, *self.dataset.test)
        cameras = len({view.camera for view in views})
        layout = f"{cameras} cameras that stand still" if self.still else "a camera that moves"
        lines = [f"{len(views)} images, {layout}", f"capture: {self.dataset.summary}", *map(str, self.measures)]
        return "\n".join([*lines, *(f" note  {warning}" for warning in self.dataset.warnings)])


def diagnose(folder: Path) -> Diagnosis:
    """Measure a capture of any format. Raises InputError where it cannot be opened."""
    dataset = load_dataset(folder, image_size=SIZE)
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.time)
    cameras = list(dict.fromkeys(view.camera for view in views))
    if dataset.cloud is not None:
        points = dataset.cloud.at_most(MOST_POINTS, 0).points.astype(np.float64)
    elif dataset.depths is not None:  # random ones where views overlap
        points = points_in_view(dataset.cameras, *dataset.depths, MOST_POINTS, 0).astype(np.float64)
    else:
        points = dataset.focus[None]
    still = len(views) >= 2 * len(cameras)
    looks = _looks(folder, views, cameras if still else None)
    measures = [parallax(cameras, points), moving_share(looks)]
    if still:
        measures += [coverage(looks), spacing(cameras, dataset.focus)]
    else:
        cloud = points if dataset.cloud is not None else np.zeros((0, 3))
        measures += [path(views, points), exposure(looks, cloud)]
    return Diagnosis(dataset, still, measures, looks)


def _looks(folder: Path, views: Sequence[View], cameras: Sequence[Camera] | None) -> list[Look]:
    """The images of some views by time, with masks. cameras: those that stand still; then all show the same times."""
    groups = [views] if cameras is None else [[view for view in views if view.camera is camera] for camera in cameras]
    chosen = [view for group in groups for view in evenly(group, max(3, MOST_VIEWS // len(groups)))]
    with ThreadPoolExecutor(4) as pool:
        looked = pool.map(lambda view: Look(view, view.load()[..., :3], _mask(folder, view)), chosen)
        looks = list(counted(looked, len(chosen), "images looked at"))
    if cameras is None:
        return looks
    masks: list[Mask] = []
    for camera in cameras:
        levels = np.stack([_gray(look.image) for look in looks if look.view.camera is camera])
        masks += list(np.abs(levels - np.median(levels, axis=0)) > 16.0)  # of 255: the pixel moves
    return [look._replace(mask=mask) for look, mask in zip(looks, masks, strict=True)]


def _mask(folder: Path, view: View) -> Mask | None:
    """The mask that lapgs-prepare wrote for the image of a view."""
    image = Path(view.source)
    if not image.is_relative_to(folder / IMAGES):
        return None
    path = folder / MASKS / image.relative_to(folder / IMAGES).with_suffix(".png")
    return decode_mask(path) if path.is_file() else None


def parallax(cameras: Sequence[Camera], points: Floats) -> Measure:
    """The largest angle between two cameras that see a point, the median over the points."""
    chosen = evenly(cameras, MOST_CAMERAS)
    seen = np.stack([in_view(points, camera)[1] for camera in chosen])
    away = points - np.stack([camera.position for camera in chosen])[:, None]
    rays = np.where(seen[..., None], away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-12), np.nan)
    least = np.fmin.reduce(np.einsum("cni,dni->cdn", rays, rays), axis=(0, 1))[seen.sum(axis=0) > 1]
    degrees = float(np.median(np.degrees(np.arccos(np.clip(least, -1, 1))))) if len(least) else 0.0
    value = f"{degrees:.1f} degrees between the two cameras furthest apart that see a point"
    advice = "walk (further) around what moves instead of turning on the spot, or put the cameras further apart: depth "
    advice += "is a guess, and the other sides stay empty"
    # Half a pixel of a phone's image is 1 % of the depth at 5 degrees.
    return Measure("parallax", 5, math.inf, "5 or more", advice, degrees, value)


def path(views: Sequence[View], points: Floats) -> Measure:
    """Of a camera that moves: whether its path is one that a hand can walk."""
    places = np.stack([view.camera.position for view in views])
    axes = np.stack([view.camera.T_cam_world[2, :3] for view in views])
    faults = path_faults(places, axes, points, [view.source for view in views])
    value = ", ".join(f"{what} at {Path(views[i].source).name}" for what, i in faults[:NAMED])
    value += f" and {len(faults) - NAMED} more" if len(faults) > NAMED else ""
    wanted = f"no step above {STEP:g} and no turn above {TURN:g} times the usual one, no doubling back or stall, at "
    wanted += f"most {AROUND:g} degrees a second around the scene"
    advice = "the cameras are likely wrong there: cut the film at these images, or film that part more slowly"
    return Measure("path", 0, 0, wanted, advice, len(faults), value or "smooth")


def moving_share(looks: Sequence[Look]) -> Measure:
    """Share of the images that moves."""
    measure = Measure("moving share", LITTLE, 0.5, "1% to 50%", "no masks of what moves, which lapgs-prepare makes")
    shares = [look.mask.mean() for look in looks if look.mask is not None]
    if not shares:
        return measure
    share = float(np.mean(shares))
    advice = "leave more of what stands still in the picture, since the cameras are placed by that"
    if share < LITTLE:
        advice = "film longer, or closer, or train with --field static: hardly anything moves"
    return measure._replace(number=share, value=f"{share:.1%} of the image area moves", advice=advice)


def coverage(looks: Sequence[Look]) -> Measure:
    """Of cameras that stand still: how many see something move at one time."""
    seen = Counter(round(look.view.time, 6) for look in looks if look.mask is not None and look.mask.mean() > SEEN)
    cameras = float(np.median(list(seen.values()) or [0]))
    advice = "aim more cameras at what moves: where less than three see it, its place in depth is a guess"
    value = f"{cameras:g} cameras see something move at one time"
    return Measure("coverage", 3, math.inf, "3 or more", advice, cameras, value)


def spacing(cameras: Sequence[Camera], focus: Floats) -> Measure:
    """Of cameras that stand still, how far they stand apart, seen from what they look at (3,)."""
    degrees = degrees_apart(cameras, focus)
    advice = "put more cameras between them: so far apart none confirms the depths that another one sees, and views "
    advice += "between them, such as the held-out one, show blobs"
    value = f"{degrees:.0f} degrees from a camera to the nearest other one"
    return Measure("spacing", 0, FAR_APART, f"{FAR_APART:g} or less", advice, degrees, value)


def exposure(looks: Sequence[Look], points: Floats) -> Measure:
    """How the same points (n, 3) of the cloud change in brightness: stops between the images, 5 to 95 % of them."""
    levels = np.full((len(looks), len(points)), np.nan)
    for stops_of, (view, image, _) in zip(levels, looks, strict=True):
        _, seen = in_view(points, view.camera)
        pixels, _ = view.camera.project(points[seen])
        column, row = np.clip(np.floor(pixels).astype(np.int64), 0, [view.camera.width - 1, view.camera.height - 1]).T
        stops_of[seen] = np.log2(np.maximum((_gray(image)[row, column] / 255) ** 2.2, 1e-3))
    levels = levels[:, np.isfinite(levels).any(axis=0)]
    levels -= np.nanmedian(levels, axis=0)
    gains = [np.nanmedian(row) for row in levels if np.isfinite(row).sum() >= POINTS_SEEN]
    few = f"less than 3 images show {POINTS_SEEN} points of a cloud"
    measure = Measure("exposure", 0, 0.3, "0.3 stops or less", few)
    if len(gains) < 3:
        return measure
    stops = float(np.ptp(np.percentile(gains, [5, 95])))
    value = f"changes by {stops:.2f} stops between dark and bright images"
    advice = "lock exposure and white balance; --train corrects each image's colors"
    return measure._replace(number=stops, value=value, advice=advice)


def _gray(image: Pixels) -> NDArray[np.float32]:
    """Gray levels (h, w), 0 to 255, of RGB."""
    return image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
