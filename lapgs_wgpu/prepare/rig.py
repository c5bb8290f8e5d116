"""Cameras that stand still and film together: placed by what they see, or by a calibration, with images of one size."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.images import Size, shrunk_size, size_text
from lapgs_wgpu.data.readers.panoptic import FILES, IMAGES
from lapgs_wgpu.data.stamps import natural_key
from lapgs_wgpu.data.timestamps import CAMERAS
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.calibration import Calibrated, match_names, read_calibration
from lapgs_wgpu.prepare.capture_folder import RefusedError
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.images import LONGER_SIDE, Picture, Shape, common_times, extract_in_step
from lapgs_wgpu.prepare.poses import Reconstruction, merged
from lapgs_wgpu.progress import say

TIMES = 8  # at which still cameras are compared
LENS = "SIMPLE_RADIAL"  # few images do not determine more parameters
MOST_CUT = 0.5  # share of the area of a camera's images that is lost where all get one size


def shapes_of(films: Sequence[Film]) -> tuple[Size, list[Shape], list[Size]]:
    """The size of all images, how each camera's frames get it, and the sizes to which they are shrunk before.

    Raises InputError for films of so different proportions that more than half of one would be cut off.
    """
    for film in films:
        next(film.frames(), None)  # which says how the film is turned
    sizes = [shrunk_size(film.size, LONGER_SIDE) for film in films]
    width, height = min(w for w, _ in sizes), min(h for _, h in sizes)
    shapes, covering = [], []
    for film, (w, h) in zip(films, sizes, strict=True):
        side = math.ceil(max(w, h) * max(width / w, height / h) - 1e-9)
        w, h = shrunk_size((w, h), side)
        if width * height < (1 - MOST_CUT) * w * h:
            raise InputError(
                f"{film.path} is {size_text(film.size)} pixels, of which {width * height / (w * h):.0%} would be left: "
                f"the films are {', '.join(sorted({size_text(each.size) for each in films}))}, and all get one size; "
                "leave out those of other proportions, or cut them."
            )
        left, top = (w - width) // 2, (h - height) // 2
        shapes.append(Shape(side, (slice(top, top + height), slice(left, left + width))))
        covering.append((w, h))
    if len(set(sizes)) > 1:
        say(f"the films have {len(set(sizes))} sizes: all images become {size_text((width, height))} pixels.")
    return (width, height), shapes, covering


def place_still(films: Sequence[Film], images: Path, fps: float, work: Path) -> tuple[list[Picture], Any]:
    """Compare all cameras at several times. Returns the images and the pycolmap.Reconstruction. Raises InputError."""
    _, shapes, covering = shapes_of(films)
    cameras = extract_in_step(films, images, fps, shapes)
    times = [[picture.name for picture in each] for each in common_times(cameras, TIMES)]
    if not times:
        most = max(map(len, cameras))
        raise InputError(f"of {most} times, all {len(films)} films have none in common; cut them to begin together.")
    groups = list(zip(*times, strict=True))  # of each camera
    names = [name for group in groups for name in group]
    source = Reconstruction(images, names, work, LENS, "SINGLE" if len(set(covering)) == 1 else "PER_FOLDER")
    pairs = [pair for names in times for pair in itertools.combinations(names, 2)]
    source.match(pairs)
    joined = merged(source, groups, work / "merged")
    model = joined.solve()
    placed, least = 0 if model is None else model.num_reg_images(), max(2, len(groups) // 2)
    if placed < least:
        shared = {pair: len(found) for pair, found in joined.verified().items()} or {("no camera",) * 2: 0}
        one, other = max(shared, key=lambda pair: shared[pair])
        raise RefusedError(
            f"{placed} of {len(groups)} cameras could be placed (at least {least} are needed): {one} and {other} share "
            f"most, {max(shared.values())} places at {len(times)} times; put cameras between them, less than 30 "
            "degrees apart, or give where they stand (--calibration FILE)."
        )
    return [picture for camera in cameras for picture in camera], model


def place_calibrated(films: Sequence[Film], folder: Path, fps: float, calibration: Path) -> list[Picture]:
    """Write undistorted images and cameras in Panoptic's layout: no training changes its cameras. Raises InputError."""
    if len(films) < CAMERAS:
        raise InputError(f"{len(films)} films: a calibration needs {CAMERAS} cameras, of which the first is held out.")
    cameras = _assigned(films, read_calibration(calibration), calibration)
    (width, height), shapes, covering = shapes_of(films)
    pinholes = []
    for i, (film, camera, (w, h)) in enumerate(zip(films, cameras, covering, strict=True)):
        lens = camera.lens_for((w, h), film.size)
        rows, columns = shapes[i].cut
        K = lens.pinhole(camera.where)
        K[:2, 2] -= columns.start, rows.start
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        bent = lens.project((pixels - K[:2, 2]) / K[[0, 1], [0, 1]]) - 0.5
        shapes[i] = shapes[i]._replace(bent=bent.astype(np.float32))
        pinholes.append(K)
    pictures = extract_in_step(films, folder / IMAGES, fps, shapes)
    times = common_times(pictures, len(pictures[0]))
    for numbers, file in (([0], FILES["test"]), (range(1, len(films)), FILES["train"])):
        table = {
            "fn": [[time[n].name for n in numbers] for time in times],
            "k": [[pinholes[n].tolist() for n in numbers]] * len(times),
            "w2c": [[cameras[n].T_cam_world.tolist() for n in numbers]] * len(times),
            "cam_id": [list(numbers)] * len(times),
        }
        (folder / file).write_text(json.dumps({"w": width, "h": height, **table}), encoding="utf-8")
    return [picture for time in times for picture in time]


def _assigned(films: Sequence[Film], cameras: dict[str, Calibrated], calibration: Path) -> list[Calibrated]:
    """The camera of each film, by its name, else by the order. Raises InputError."""
    names = [film.path.name for film in films]
    found = match_names(cameras, names)
    if not found and len(cameras) == len(films):
        found = dict(zip(sorted(names, key=natural_key), sorted(cameras, key=natural_key), strict=True))
    missing = [name for name in names if name not in found]
    if missing or len(set(found.values())) < len(films):
        raise InputError(
            f"{calibration} has {len(cameras)} cameras ({', '.join(list(cameras)[:8])}), and none of its own for "
            f"{missing[0] if missing else names[0]}; name each film as its camera."
        )
    say(f"{calibration}: " + ", ".join(f"{name} is camera {found[name]}" for name in names))
    return [cameras[found[name]] for name in names]
