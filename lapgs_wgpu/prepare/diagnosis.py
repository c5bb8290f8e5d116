"""What a capture is worth: a number for each property that decides, its threshold, and what to film differently."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lapgs_wgpu.data import Dataset, View, load_dataset
from lapgs_wgpu.data.cloud import points_in_view
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.readers.colmap import IMAGES
from lapgs_wgpu.prepare.masks import MASKS, Mask, read_mask
from lapgs_wgpu.prepare.measures import (
    Floats,
    Look,
    Measure,
    blur_measure,
    coverage_of_moving,
    coverage_of_still,
    distinct_cameras,
    exposure,
    gray,
    moving_share,
    parallax,
    path,
)
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.camera import Camera

SIZE = 320  # longer side of the images that are looked at, pixels
MOST_VIEWS = 96  # of a capture that are looked at, evenly chosen over the clip
MOST_POINTS = 1500  # of the scene, at which angles are measured
LEVELS = 16.0  # of 255 from the median over the clip: the pixel of a still camera moves


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """dataset: images of SIZE pixels. still: the cameras stand still. looks: by camera, then time."""

    dataset: Dataset
    still: bool
    measures: tuple[Measure, ...]
    looks: tuple[Look, ...]

    def measure(self, name: str) -> Measure:
        return next(each for each in self.measures if each.name == name)

    def __str__(self) -> str:
        views = (*self.dataset.train, *self.dataset.test)
        layout = f"{len(distinct_cameras(views))} cameras that stand still" if self.still else "a camera that moves"
        understood = [f"capture: {self.dataset.summary}"] if self.dataset.summary else []
        lines = [f"{len(views)} images, {layout}", *understood, *map(str, self.measures)]
        return "\n".join([*lines, *(f" note  {warning}" for warning in self.dataset.warnings)])


def diagnose(folder: Path) -> Diagnosis:
    """Measure a capture of any format. Raises InputError where it cannot be opened."""
    dataset = load_dataset(folder, image_size=SIZE)
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.time)
    cameras = distinct_cameras(views)
    still = len(views) >= 2 * len(cameras)
    looks = _looks(folder, views, cameras if still else None)
    points = _points(dataset)
    measures = [
        parallax(cameras, points),
        *([] if still else [path(views, points)]),
        moving_share(looks),
        coverage_of_still(looks) if still else coverage_of_moving(cameras, points),
        blur_measure(looks),
        exposure(looks, points if dataset.cloud is not None else None, still),
    ]
    return Diagnosis(dataset, still, tuple(measures), tuple(looks))


def _looks(folder: Path, views: Sequence[View], cameras: Sequence[Camera] | None) -> list[Look]:
    """The images of some views by time, with masks. cameras: those that stand still; then all show the same times."""
    if cameras is None:
        chosen = evenly(views, MOST_VIEWS)
    else:
        each = [[view for view in views if view.camera is camera] for camera in cameras]
        times = max(3, MOST_VIEWS // len(cameras))
        chosen = [view for own in each for view in evenly(own, times)]
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
            levels = np.stack([gray(i) for i, view in zip(images, chosen, strict=True) if view.camera is camera])
            masks += list(np.abs(levels - np.median(levels, axis=0)) > LEVELS)
    return [Look(*each) for each in zip(chosen, images, masks, strict=True)]


def _mask(folder: Path, view: View) -> Mask | None:
    """The mask that lapgs-prepare wrote for the image of a view."""
    image = Path(view.source)
    if not image.is_relative_to(folder / IMAGES):
        return None
    path = folder / MASKS / image.relative_to(folder / IMAGES).with_suffix(".png")
    return read_mask(path) if path.is_file() else None


def _points(dataset: Dataset) -> Floats:
    """(N, 3) points of the scene: of its cloud, else random ones where views overlap, else what cameras look at."""
    random = np.random.default_rng(0)
    if dataset.cloud is not None:
        points = dataset.cloud.points
        return points[random.permutation(len(points))[:MOST_POINTS]].astype(np.float64)
    if dataset.depths is not None:
        return points_in_view(dataset.cameras, *dataset.depths, MOST_POINTS, 0).astype(np.float64)
    return dataset.focus[None]
