"""Which cameras explain a film: a pan, or the best of reconstructions that begin with several focal lengths."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lapgs_wgpu.data.images import decode
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.prepare.pan import Pan, rays, solve_pan
from lapgs_wgpu.prepare.poses import Floats, Reconstruction, import_pycolmap, without
from lapgs_wgpu.progress import say

FOCALS = 1.0, 1.4, 0.7  # times the width, where EXIF says nothing
PURE, NEARLY = 0.8, 0.6  # share of the verified matches that turning alone explains: a pan; one, if nothing else fits
GOOD, SHARP = 0.95, 1.5e-3  # the search ends: share of the images, and the mean error in parts of the longer side
SECONDS, SECONDS_EACH, CORES = 20.0, 0.6, 2  # of the search: for any film, and for each image, on so many cores
STEP, TURN = 8.0, 8.0  # of a path that a hand can walk: largest step and turn over their medians
AROUND = 75.0  # degrees a second, around the middle of the scene, at most
FEWEST = 8  # images whose path is judged


class Found(NamedTuple):
    """model: a pycolmap.Reconstruction. placed: names of its images, in the order of time. faults: number, of its path
    and its lens. error: mean, pixels. focal: at the end, pixels. pan: None where the camera walks. together: all
    cameras were placed at once. held: the focal length is not the film's, but where the search began."""

    model: Any
    placed: tuple[str, ...]
    faults: int
    error: float
    focal: float
    pan: Pan | None = None
    together: bool = False
    held: bool = False


def search(source: Reconstruction, *, rival: bool = False) -> Found | None:
    """The cameras that explain most images, then least implausibly, then best. None where no two images fit together.

    source: with verified matches. rival: whether there are other cameras to compare with: then the first result with
    enough images ends the search.
    """
    pan = solve_pan(source.names, source.places, source.verified(), source.size, source.prior)
    if pan is not None and pan.explained >= PURE:
        return panned(source, pan)
    count, seconds = len(source.names), SECONDS + SECONDS_EACH * len(source.names)
    focals = [source.prior] * source.exif + [focal * source.size[0] for focal in FOCALS]
    tries = [(focal, True, False) for focal in focals[:2]] + [(focals[0], way, True) for way in (True, False)]
    tries += [(focal, False, False) for focal in focals] + [(focal, True, False) for focal in focals[2:]]
    best: Found | None = None
    wall, processor, spent, longest = time.monotonic(), time.process_time(), 0.0, 0.0
    for number, (focal, together, held) in enumerate(tries):
        left = seconds - spent
        if best is not None and left < longest:
            break
        # COLMAP's limit is time on the wall, which what else a machine does must not shorten.
        slower = max(1.0, (time.monotonic() - wall) / max(spent, 1.0))
        found = _solved(source, focal, together, held, max(left, 10) * slower)
        before, spent = spent, (time.process_time() - processor) / CORES
        longest = max(longest, spent - before)
        if found is not None:
            wrong = f"{found.error:.2f} pixels off, {found.faults} faults of the path"
            say(f"{len(found.placed)} of {count} cameras placed, {wrong}")
            best = max(best or found, found, key=lambda it: (round(20 * len(it.placed) / count), -it.faults, -it.error))
        if best is not None and len(best.placed) >= GOOD * count:
            good = not best.faults and best.error < max(1.0, SHARP * max(source.size))
            if rival or (number and good):
                break  # the first one alone may be wrong, and no measure of it tells
    short = best is None or len(best.placed) < GOOD * count
    return panned(source, pan) if pan is not None and short and pan.explained >= NEARLY else best


def _solved(source: Reconstruction, focal: float, together: bool, held: bool, seconds: float) -> Found | None:
    model = source.solve(focal, together=together, held=held, seconds=seconds)
    return described(source, model, together=together, held=held)


def described(source: Reconstruction, model: Any, *, together: bool = False, held: bool = False) -> Found | None:
    """A reconstruction, and what tells how good it is. None where it has no points."""
    if model is None or model.num_reg_images() < 2 or not model.num_points3D():
        return None
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    placed = tuple(name for name in source.names if name in images)
    places = np.stack([images[name].projection_center() for name in placed])
    axes = np.stack([images[name].viewing_direction() for name in placed])
    points = np.stack([point.xyz for point in model.points3D.values()])
    camera = next(iter(model.cameras.values()))
    bent = camera.model.name == "RADIAL" and abs(camera.params[3]) > 0.4  # as no camera's lens is
    faults = len(path_faults(places, axes, points, placed)) + bent
    error = float(model.compute_mean_reprojection_error())
    return Found(model, placed, faults, error, camera.mean_focal_length(), together=together, held=held)


def panned(source: Reconstruction, pan: Pan) -> Found:
    """A pan as a reconstruction, with some 3000 points of its features on a sphere of radius 1."""
    rng, size = np.random.default_rng(0), source.size
    lens = Lens(*size, pan.focal, pan.focal, size[0] / 2, size[1] / 2, radial=(pan.radial, 0.0, 0.0))
    rotations = dict(zip(source.names, pan.rotations, strict=True))
    model = source.unpointed({name: (lens, np.pad(R, ((0, 0), (0, 1)))) for name, R in rotations.items()})
    for name, rotation in rotations.items():
        at = source.places[name][:, :2].astype(np.float64)
        at = at[rng.permutation(len(at))[: max(1, 3000 // len(rotations))]]
        ray = rays(at - np.array(size) / 2, pan.focal, pan.radial)
        points = ray / np.linalg.norm(ray, axis=1, keepdims=True) @ rotation
        column, row = np.clip(at.astype(int), 0, [size[0] - 1, size[1] - 1]).T
        for point, color in zip(points, decode(source.images / name)[row, column], strict=True):
            model.add_point3D(point, import_pycolmap().Track(), color)
    return Found(model, tuple(rotations), 0, 0.0, pan.focal, pan)


def again(source: Reconstruction, found: Found, masks: Mapping[str, Mask]) -> Found | None:
    """The cameras without what masks cover, from where the search ended."""
    if found.pan is not None:
        rest = without(source.verified(), source.places, masks, source.size)
        pan = solve_pan(source.names, source.places, rest, source.size, found.pan.focal)
        return None if pan is None else panned(source, pan)
    source.verify(masks)
    return _solved(source, found.focal, found.together, found.held, SECONDS + SECONDS_EACH * len(source.names))


def longest_part(names: Sequence[str], placed: Sequence[str]) -> list[str]:
    """The longest run of placed images, in which at most 2 images in a row are missing."""
    steps = np.diff([names.index(name) for name in placed])
    return max(np.split(np.array(placed), np.flatnonzero(steps > 3) + 1), key=len).tolist()


def path_faults(places: Floats, axes: Floats, points: Floats, names: Sequence[str]) -> list[tuple[str, int]]:
    """The faults of a path, with the number of the image at which each is.

    places, axes: (n, 3) of the cameras and where they look, in the order of time. points: (N, 3) of the scene. names:
    of the images, which are milliseconds in films. Steps that are small beside the scene's distance are noise, of a
    camera that turns or stands.
    """
    if len(places) < FEWEST:
        return []
    steps = np.diff(places, axis=0)
    length = np.linalg.norm(steps, axis=1)
    away = float(np.median(np.linalg.norm(points - np.median(places, axis=0), axis=1)))
    usual = max(float(np.median(length)), 1e-3 * away)
    turns = np.degrees(np.arccos(np.clip((axes[1:] * axes[:-1]).sum(axis=1), -1, 1)))
    turn = max(float(np.median(turns)), 0.5)
    cosine = (steps[1:] * steps[:-1]).sum(axis=1) / np.maximum(length[1:] * length[:-1], 1e-12)
    back = (cosine < -0.5) & (np.minimum(length[1:], length[:-1]) > max(usual, 1e-2 * away))
    still = length < (0.02 * usual if np.median(length) == usual else 0.0)
    long = max(3, len(still) // 10)
    stalls = [i for i in range(len(still) - long + 1) if still[i : i + long].all()][:1]
    leaps, jerks = np.flatnonzero(length > STEP * usual).tolist(), np.flatnonzero(turns > TURN * turn).tolist()
    faults = [(f"a step of {length[i] / usual:.0f} times the usual one", i + 1) for i in leaps]
    faults += [(f"a turn of {turns[i]:.0f} degrees", i + 1) for i in jerks]
    faults += [("the path doubles back", i + 1) for i in np.flatnonzero(back).tolist()]
    faults += [("the path stalls", i) for i in stalls]
    stems = [Path(name).stem for name in names]
    if all(len(stem) == 8 and stem.isdecimal() for stem in stems):
        seconds = (int(stems[-1]) - int(stems[0])) / 1000
        around = (places[[0, -1]] - np.median(points, axis=0)) / away
        speed = np.degrees(2 * np.arcsin(min(float(np.linalg.norm(around[1] - around[0])) / 2, 1.0))) / seconds
        faults += [(f"{speed:.0f} degrees a second around the scene", 0)] * bool(speed > AROUND)
    return faults
