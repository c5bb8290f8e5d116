"""Which cameras explain a film: a pan, or the best of reconstructions that begin with several focal lengths."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from lapgs_wgpu.data.images import Size
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.prepare.movers import without
from lapgs_wgpu.prepare.pan import Pan, rays, solve_pan
from lapgs_wgpu.prepare.path import path_faults
from lapgs_wgpu.prepare.poses import Match, Reconstruction, import_pycolmap, reconstruction
from lapgs_wgpu.progress import say

FOCALS = 1.0, 1.4, 0.7  # times the width, where EXIF says nothing
PURE, NEARLY = 0.8, 0.6  # share of the verified matches that turning alone explains: a pan; one, if nothing else fits
GOOD, SHARP = 0.95, 1.5e-3  # the search ends: share of the images, and the mean error in parts of the longer side
SECONDS, SECONDS_EACH, CORES = 20.0, 0.6, 2  # of the search: for any film, and for each image, on so many cores
BENT = 0.4  # first radial coefficient of a lens, at most
PANORAMA = 3000  # points of a pan


class Found(NamedTuple):
    """model: a pycolmap.Reconstruction. placed: names of its images, in the order of time. faults: of its path, by the
    images' numbers in `placed`. error: mean, pixels. focal: at the end, pixels. pan: None where the camera walks.
    together: all cameras were placed at once. held: the focal length is not the film's, but where the search began."""

    model: Any
    placed: tuple[str, ...]
    faults: tuple[tuple[str, int], ...]
    error: float
    focal: float
    pan: Pan | None = None
    together: bool = False
    held: bool = False


def search(source: Reconstruction, size: Size, *, rival: bool = False) -> Found | None:
    """The cameras that explain most images, then least implausibly, then best. None where no two images fit together.

    source: with verified matches. size: (width, height) of its images. rival: whether there are other cameras to
    compare with: then the first result with enough images ends the search.
    """
    pan = solve_pan(source.names, source.places, source.verified(), size, source.prior)
    if pan is not None and pan.explained >= PURE:
        return panned(source, pan, size)
    focals = [source.prior, *FOCALS] if source.exif else list(FOCALS)
    pixels = [f if source.exif and f == source.prior else f * size[0] for f in focals]
    tries = [(f, True, False) for f in pixels[:2]] + [(pixels[0], way, True) for way in (True, False)]
    tries += [(f, False, False) for f in pixels] + [(f, True, False) for f in pixels[2:]]
    best: Found | None = None
    longest, spent = 0.0, _Spent()
    for number, (focal, together, held) in enumerate(tries):
        left = SECONDS + SECONDS_EACH * len(source.names) - spent.seconds
        if best is not None and left < longest:
            break
        started = spent.seconds
        seconds = max(left, 10) * spent.slower
        model = source.solve(focal, together=together, held=held, seconds=seconds)
        found = described(source, model, together=together, held=held)
        longest = max(longest, spent.seconds - started)
        if found is not None and (best is None or _rank(source, found) > _rank(source, best)):
            best = found
        if best is not None and len(best.placed) >= GOOD * len(source.names):
            good = not best.faults and best.error < max(1.0, SHARP * max(size))
            if rival or (number and good):
                break  # the first one alone may be wrong, and no measure of it tells
        if found is not None:
            rest = max(left + started - spent.seconds, 0) * spent.slower
            more = f"{len(found.faults)} faults of the path; " * bool(found.faults)
            say(
                f"{len(found.placed)} of {len(source.names)} cameras placed, {found.error:.2f} pixels off; {more}"
                f"looking for better ones for at most {rest:.0f} s more"
            )
    short = best is None or len(best.placed) < GOOD * len(source.names)
    if pan is not None and short and pan.explained >= NEARLY:
        return panned(source, pan, size)
    return best


class _Spent:
    """The time of this process on CORES cores, so that what else a machine does changes no result."""

    def __init__(self) -> None:
        self._wall, self._processor = time.monotonic(), time.process_time()

    @property
    def seconds(self) -> float:
        return (time.process_time() - self._processor) / CORES

    @property
    def slower(self) -> float:
        """By how much time passes faster than that, at least 1."""
        return max(1.0, (time.monotonic() - self._wall) / max(self.seconds, 1.0))


def described(source: Reconstruction, model: Any, *, together: bool = False, held: bool = False) -> Found | None:
    """A reconstruction, and what tells how good it is. None where it has no points."""
    if model is None or model.num_reg_images() < 2 or not model.num_points3D():
        return None
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    placed = tuple(name for name in source.names if name in images)
    poses = np.stack([images[name].cam_from_world().matrix() for name in placed])
    points = np.stack([point.xyz for point in model.points3D.values()])
    faults = path_faults(-np.einsum("nij,ni->nj", poses[:, :, :3], poses[:, :, 3]), poses[:, 2, :3], points, placed)
    camera = next(iter(model.cameras.values()))
    if source.model == camera.model.name and abs(camera.params[3]) > BENT:
        faults.append(("a lens that no camera has", 0))
    error = float(model.compute_mean_reprojection_error())
    return Found(model, placed, tuple(faults), error, camera.mean_focal_length(), together=together, held=held)


def panned(source: Reconstruction, pan: Pan, size: Size) -> Found:
    """A pan as a reconstruction, with points of its features on a sphere of radius 1."""
    rng = np.random.default_rng(0)
    points, colors = [], []
    each = max(1, PANORAMA // len(source.names))
    for name, rotation in zip(source.names, pan.rotations, strict=True):
        at = source.places[name][:, :2].astype(np.float64)
        at = at[rng.permutation(len(at))[:each]]
        ray = rays(at - np.array(size) / 2, pan.focal, pan.radial)
        points.append(ray / np.linalg.norm(ray, axis=1, keepdims=True) @ rotation)
        with Image.open(source.images / name) as image:
            pixels = np.asarray(image.convert("RGB"))
        column, row = np.clip(at.astype(int), 0, [size[0] - 1, size[1] - 1]).T
        colors.append(pixels[row, column])
    lens = Lens(*size, pan.focal, pan.focal, size[0] / 2, size[1] / 2, radial=(pan.radial, 0.0, 0.0))
    poses = {name: np.hstack([R, np.zeros((3, 1))]) for name, R in zip(source.names, pan.rotations, strict=True)}
    model = reconstruction(dict.fromkeys(source.names, lens), poses, source.cameras, source.ids)
    for point, color in zip(np.concatenate(points), np.concatenate(colors), strict=True):
        model.add_point3D(point, import_pycolmap().Track(), color)
    return Found(model, tuple(source.names), (), 0.0, pan.focal, pan)


def again(source: Reconstruction, found: Found, matches: Match, masks: Mapping[str, Mask], size: Size) -> Found | None:
    """The cameras without what masks cover, from where the search ended. matches: all of them."""
    if found.pan is not None:
        rest = without(source.verified(), source.places, masks, size)
        pan = solve_pan(source.names, source.places, rest, size, found.pan.focal)
        return None if pan is None else panned(source, pan, size)
    source.use(without(matches, source.places, masks, size))
    seconds = SECONDS + SECONDS_EACH * len(source.names)
    model = source.solve(found.focal, together=found.together, held=found.held, seconds=seconds)
    return described(source, model, together=found.together, held=found.held)


def _rank(source: Reconstruction, found: Found) -> tuple[float, float, float]:
    return round(20 * len(found.placed) / len(source.names)), -float(len(found.faults)), -found.error


def longest_part(names: Sequence[str], placed: Sequence[str], gap: int) -> tuple[str, ...]:
    """The longest run of placed images, in which at most `gap` images in a row are missing."""
    number = {name: i for i, name in enumerate(names)}
    ends = [0, *(i for i in range(1, len(placed)) if number[placed[i]] - number[placed[i - 1]] > gap + 1), len(placed)]
    first, last = max(itertools.pairwise(ends), key=lambda part: part[1] - part[0])
    return tuple(placed[first:last])
