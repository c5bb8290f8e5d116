"""How well a run shows the moving objects of a motion scene: python benchmarks/object_metrics.py RUN... prints a
Markdown table of PSNR, silhouette and displacement of the objects, means over the test views and the objects, from
images alone; and by the paths of its Gaussians, how they turn, and how often they change over to another object. The
capture of each RUN is a scene of motion_writer.

A rendering's silhouette of an object is found by color, so the measure is the same for every representation. A pixel
is claimed for the object where the rendering

- differs from the clean plate (the true view without the object) by at least CONTRAST of what the truth differs there
  or, outside the true mask, of the median of that difference over the mask: a ghost of low opacity claims nothing; and
- is nearer to a color of the object than to any color of the clean plate: blurred or misplaced parts of the rest of
  the scene claim nothing.

Pixels count within REACH diameters of the true mask, except those of other moving objects, and except those of the
object that have the clean plate's color.
"""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean, median
from typing import NamedTuple

import numpy as np
from motion_scenes import MotionScene, MovingObject, moving_objects
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lapgs_wgpu import load, open_device
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.views import View, composite
from lapgs_wgpu.train.config import BACKGROUND_LEVELS
from lapgs_wgpu.train.evaluate import to_8_bit
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import open_data

CONTRAST = 0.5
REACH = 1.0  # diameters from the true mask within which a silhouette is looked for
MARGIN = 1.0  # pixels by which the true mask is dilated for the PSNR
LEAST_DIFFERENCE = 16.0  # levels of 255, over the channels: less between object and clean plate cannot be told apart
VISIBLE_PIXELS, VISIBLE_SHARE = 20, 0.25  # least of an object that must be seen: pixels, share of its whole disc
LEAST_CLAIM = 0.1  # a silhouette of fewer pixels than this share of the true one has no centroid
FOUND_IOU = 0.5
TURNED = 3.0  # degrees from the true orientation, up to which one is right
LEAST_OWN = 4  # Gaussians of an object
OPAQUE = 0.3  # Gaussians of less opacity tell nothing of an object's pose

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ObjectTruth:
    """One moving object in one test view.

    diameter: of its projection, pixels. mask: decodes the coverage of each pixel by the object: (H, W) uint8. clean:
    decodes the view without the object: (H, W, 3) RGB or (H, W, 4) straight RGBA, uint8.
    """

    name: str
    diameter: float
    mask: Callable[[], Image]
    clean: Callable[[], Image]


def object_truths(folder: Path, split: str, views: Sequence[View]) -> list[list[ObjectTruth]]:
    """The moving objects of each view of a split of a motion scene, whose coordinates are the capture's."""
    moving = [one for one in json.loads((folder / "objects.json").read_text())["objects"] if one["moves"]]

    def truth(one: dict, index: int, view: View) -> ObjectTruth:
        camera = view.camera
        depth = float((camera.T_cam_world @ [*one["positions"][split][index], 1.0])[2])
        mask, clean = (folder / part / split / f"r_{index:03d}_{one['name']}.png" for part in ("masks", "clean"))
        size = (camera.width, camera.height)
        return ObjectTruth(
            one["name"],
            camera.K[0, 0] * one["diameter"] / max(depth, 1e-6),
            lambda: check_image(mask).read(size)[..., 0],
            partial(check_image(clean).read, size),
        )

    return [[truth(one, index, view) for one in moving] for index, view in enumerate(views)]


@dataclass(frozen=True)
class ObjectFrame:
    """One object in one test view. psnr: dB where it is, or is claimed to be. iou: of the silhouettes.
    distance: between their centroids, diameters; None where the rendering has no silhouette."""

    name: str
    psnr: float
    iou: float
    distance: float | None


def measure_objects(
    image: Image, truth: Image, objects: Sequence[ObjectTruth], background: ArrayLike
) -> list[ObjectFrame]:
    """Measure every object that is visible in a view.

    Args:
        image: (H, W, 3) uint8, the rendering.
        truth: (H, W, 3) uint8, the ground truth on the background.
        objects: the truth about the view's objects.
        background: (3,) in [0, 1], behind transparent clean plates.

    Raises:
        InputError: a mask or clean plate cannot be read.
    """
    masks = [one.mask() for one in objects]
    frames = []
    for one, mask in zip(objects, masks, strict=True):
        if not visible(mask, one.diameter):
            continue
        others = np.zeros(mask.shape, dtype=bool)
        for other in masks:
            others |= (other > 0) & (other is not mask)
        clean = composite(one.clean(), background)
        frames.append(measure_object(one.name, image, truth, clean, mask, others, one.diameter))
    return frames


def visible(mask: Image, diameter: float) -> bool:
    """Whether enough of an object is visible. mask: (H, W) uint8. diameter: of the whole object, pixels."""
    disc = np.pi / 4 * diameter**2
    return bool(np.count_nonzero(mask >= 128) >= max(VISIBLE_PIXELS, VISIBLE_SHARE * disc))


def measure_object(
    name: str, image: Image, truth: Image, clean: Image, mask: Image, others: Mask, diameter: float
) -> ObjectFrame:
    """Compare one visible object.

    Args:
        image, truth, clean: (H, W, 3) uint8: rendering, ground truth, ground truth without the object.
        mask: (H, W) uint8, the share of each pixel that shows the object.
        others: (H, W) pixels that show other moving objects.
        diameter: of the object, pixels.
    """
    shown = mask >= 128
    claimed, counted = silhouette(image, truth, clean, mask, others, diameter)
    true = shown & counted
    union = np.count_nonzero(true | claimed)
    iou = float(np.count_nonzero(true & claimed) / union) if union else 0.0
    distance = None
    if np.count_nonzero(claimed) >= max(1.0, LEAST_CLAIM * np.count_nonzero(true)) and true.any():
        distance = float(np.linalg.norm(_centroid(claimed) - _centroid(true))) / diameter
    pixels = (_distance_from(mask > 0) <= MARGIN) | claimed
    return ObjectFrame(name, psnr_within(image, truth, pixels), iou, distance)


def silhouette(
    image: Image, truth: Image, clean: Image, mask: Image, others: Mask, diameter: float
) -> tuple[Mask, Mask]:
    """The pixels (H, W) that a rendering claims for an object, and those (H, W) that count. Arguments as above."""
    shown = mask >= 128
    contrast = _norm(truth, clean)
    counted = (_distance_from(shown) <= REACH * diameter) & ~others & ~(shown & (contrast < LEAST_DIFFERENCE))
    claimed = np.zeros_like(counted)
    whole = mask == 255 if (mask == 255).any() else shown
    if not (shown & counted).any():
        return claimed, counted
    needed = CONTRAST * np.where(shown, contrast, np.median(contrast[shown & counted]))
    candidates = counted & (_norm(image, clean) >= np.maximum(needed, CONTRAST * LEAST_DIFFERENCE))
    colors = image[candidates]
    own = _to_nearest(colors, truth[whole])
    rest = _to_nearest(colors, clean.reshape(-1, 3))
    claimed[candidates] = own <= rest
    return claimed, counted


def psnr_within(image: Image, truth: Image, pixels: Mask) -> float:
    """PSNR in dB over all channels of the chosen pixels (H, W), at least one; at most 100 dB."""
    return psnr_of(float(np.square(image[pixels].astype(np.float64) - truth[pixels]).mean()) / 255**2)


def summarise(frames: Sequence[ObjectFrame]) -> tuple[float, float, float]:
    """Moving PSNR (dB), share found and track error (diameters), means over the objects of the frames of all views.

    Of each object: the mean of the dB; the share of the frames with an IoU of at least FOUND_IOU; the median of the
    distances, infinite where most frames have no silhouette.
    """
    figures = []
    for name in {frame.name for frame in frames}:
        own = [frame for frame in frames if frame.name == name]
        distances = [np.inf if frame.distance is None else frame.distance for frame in own]
        found = mean(frame.iou >= FOUND_IOU for frame in own)
        figures.append((mean(frame.psnr for frame in own), found, median(distances)))
    psnr, found, track = np.mean(figures, axis=0)
    return float(psnr), float(found), float(track)


def degrees_beside(R: Doubles, true: Doubles) -> Doubles:
    """(T,) angles between rotations (T, 3, 3), but for one that all of them have in common."""
    left, _, right = np.linalg.svd((np.swapaxes(R, 1, 2) @ true).sum(axis=0))
    return np.degrees(Rotation.from_matrix(R @ left @ right @ np.swapaxes(true, 1, 2)).magnitude())


def turns_and_swaps(paths: Doubles, objects: Sequence[MovingObject], times: ArrayLike) -> tuple[float, int]:
    """Share of right orientations, mean over the objects, and how often what belongs to one is nearest to another.

    paths: (T, n, 3) of Gaussians at the times (T,), world units. To an object belong those that are in its bounding
    sphere at the middle time. Where there are none, no orientation is right.
    """
    times = np.asarray(times)
    centers = np.stack([one.positions(times) for one in objects], axis=1)
    middle, right, swaps = len(times) // 2, [], 0
    for n, one in enumerate(objects):
        own = paths[:, np.linalg.norm(paths[middle] - centers[middle, n], axis=1) < one.reach]
        if own.shape[1] < LEAST_OWN:
            right.append(0.0)
            continue
        nearest = np.linalg.norm(np.median(own, axis=1)[:, None] - centers, axis=2).argmin(axis=1)
        swaps += int(np.count_nonzero(np.diff(nearest)))
        arms = own - own.mean(axis=1, keepdims=True)
        left, _, other = np.linalg.svd(np.einsum("tni,nj->tij", arms, arms[middle]))
        left[:, :, 2] *= np.linalg.det(left @ other)[:, None]  # no mirror images
        true = np.stack([one.turn(t) for t in times])
        right.append(float((degrees_beside(left @ other, true) <= TURNED).mean()))
    return mean(right), swaps


class Figures(NamedTuple):
    """`summarise` of a finished run, and `turns_and_swaps`."""

    psnr: float
    found: float
    track: float
    turned: float
    swaps: int


def measure_run(run: Path) -> Figures:
    """The figures of a finished run on its test views. Raises InputError."""
    config = load_config(run / "config.toml")
    (_, dataset), scene = open_data(config), load(run / "checkpoint.ply", open_device())
    color = np.full(3, BACKGROUND_LEVELS[config.data.background], np.float32)
    folder = Path(config.data.path)
    frames: list[ObjectFrame] = []
    for view, objects in zip(dataset.test, object_truths(folder, "test", dataset.test), strict=True):
        image = to_8_bit(scene.render(view.camera, view.time, color.tolist(), depth=False).image)
        frames += measure_objects(image, composite(view.load(), color), objects, color)
    times = np.unique([view.time for view in dataset.test])
    opaque = scene.at(0.5).opacities.numpy(force=True) >= OPAQUE
    paths = np.stack([scene.at(float(t)).means.numpy(force=True)[opaque] for t in times])
    truth = MotionScene(**json.loads((folder / "objects.json").read_text())["scene"])
    return Figures(
        *summarise(frames), *turns_and_swaps(paths, [one for one in moving_objects(truth) if one.moves], times)
    )


def _norm(a: Image, b: Image) -> NDArray[np.float64]:
    """Euclidean distance of the colors of two (H, W, 3) images, levels of 255: (H, W)."""
    return np.sqrt(np.square(a.astype(np.float64) - b).sum(axis=2))


def _to_nearest(colors: Image, palette: Image) -> NDArray[np.float64]:
    """Distances (n,) of colors (n, 3) from the nearest of a palette (m, 3), which is rounded to 8 levels."""
    if not len(colors) or not len(palette):
        return np.full(len(colors), np.inf)
    distance, _ = cKDTree(np.unique(palette // 8, axis=0) * 8.0 + 3.5).query(colors)
    return np.asarray(distance)


def _distance_from(mask: Mask) -> NDArray[np.float64]:
    """Distance of each pixel from the nearest one of the mask, pixels; infinite where the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    return distance_transform_edt(~mask)


def _centroid(mask: Mask) -> NDArray[np.float64]:
    return np.stack(np.nonzero(mask)).mean(axis=1)


if __name__ == "__main__":
    print("| run | moving PSNR | found | track | turned | swaps |\n|---|---:|---:|---:|---:|---:|")
    for run in sys.argv[1:]:
        psnr, found, track, turned, swaps = measure_run(Path(run))
        away = "-" if track == np.inf else f"{track:.2f}"
        print(f"| {run} | {psnr:.2f} | {found:.0%} | {away} | {turned:.0%} | {swaps} |")
