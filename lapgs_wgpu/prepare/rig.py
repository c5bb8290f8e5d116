"""Cameras that stand still and film together: placed by what they see, or by a calibration, with images of one size."""

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import shrunk_size, size_text
from lapgs_wgpu.data.readers.panoptic import FILES, IMAGES
from lapgs_wgpu.data.stamps import natural_key
from lapgs_wgpu.data.timestamps import CAMERAS
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.calibration import Calibrated, match_names, read_calibration
from lapgs_wgpu.prepare.capture_folder import RefusedError
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.images import LONGER_SIDE, Picture, Shape, extract_in_step
from lapgs_wgpu.prepare.poses import Reconstruction
from lapgs_wgpu.progress import say

LENS = "SIMPLE_RADIAL"  # few images do not determine more parameters


def shapes_of(films: Sequence[Film]) -> list[Shape]:
    """How each camera's frames get the size of all images.

    Raises InputError for films of so different proportions that more than half of one would be cut off.
    """
    sizes = [shrunk_size(film.size, LONGER_SIDE) for film in films]
    width, height = np.min(sizes, axis=0).tolist()
    shapes = []
    for film, (w, h) in zip(films, sizes, strict=True):
        w, h = shrunk_size(film.size, math.ceil(max(w, h) * max(width / w, height / h) - 1e-9))
        if width * height < 0.5 * w * h:
            raise InputError(
                f"{film.path} is {size_text(film.size)} pixels, of which {width * height / (w * h):.0%} would be left, "
                f"since all films get one size, {size_text((width, height))}; leave out those of other proportions."
            )
        left, top = (w - width) // 2, (h - height) // 2
        shapes.append(Shape((w, h), (slice(top, top + height), slice(left, left + width))))
    if len(set(sizes)) > 1:
        say(f"the films have {len(set(sizes))} sizes: all images become {size_text((width, height))} pixels.")
    return shapes


def place_still(films: Sequence[Film], images: Path, fps: float, work: Path) -> tuple[list[Picture], Any]:
    """Compare all cameras at 8 times. Returns the images and the pycolmap.Reconstruction. Raises InputError."""
    shapes = shapes_of(films)
    cameras = extract_in_step(films, images, fps, shapes)
    times = evenly(common_times(cameras), 8)
    groups = [[pictures[time].name for time in times] for pictures in cameras]
    lenses = "SINGLE" if len({shape.shrunk for shape in shapes}) == 1 else "PER_FOLDER"
    shown = {group[0]: group for group in groups}
    source = Reconstruction(images, list(shown), work, LENS, lenses)
    source.match(list(itertools.combinations(shown, 2)), shown)
    model = source.solve()
    placed, least = 0 if model is None else model.num_reg_images(), max(2, len(groups) // 2)
    if placed < least:
        most = max(map(len, source.verified().values()), default=0)
        raise RefusedError(
            f"{placed} of {len(groups)} cameras could be placed (at least {least} are needed): two share {most} places "
            f"at {len(times)} times at most; put cameras between them, less than 30 degrees apart, or give where they "
            "stand (--calibration FILE)."
        )
    return [picture for pictures in cameras for picture in pictures.values()], model


def place_calibrated(films: Sequence[Film], folder: Path, fps: float, calibration: Path) -> list[Picture]:
    """Write undistorted images and cameras in Panoptic's layout: no training changes its cameras. Raises InputError."""
    if len(films) < CAMERAS:
        raise InputError(f"{len(films)} films: a calibration needs {CAMERAS} cameras, of which the first is held out.")
    cameras = _assigned(films, calibration)
    shapes = shapes_of(films)
    pinholes = []
    for i, (film, camera, shape) in enumerate(zip(films, cameras, shapes, strict=True)):
        lens = camera.lens_for(shape.shrunk, film.size)
        rows, columns = shape.cut
        width, height = columns.stop - columns.start, rows.stop - rows.start
        K = lens.pinhole(camera.where)
        K[:2, 2] -= columns.start, rows.start
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        bent = lens.project((pixels - K[:2, 2]) / K[[0, 1], [0, 1]]) - 0.5
        shapes[i] = shape._replace(bent=bent.astype(np.float32))
        pinholes.append(K.tolist())
    pictures = extract_in_step(films, folder / IMAGES, fps, shapes)
    times = common_times(pictures)
    for file, own in ((FILES["test"], slice(1)), (FILES["train"], slice(1, None))):
        table = {
            "fn": [[pictures_of[time].name for pictures_of in pictures[own]] for time in times],
            "k": [pinholes[own]] * len(times),
            "w2c": [[camera.T_cam_world.tolist() for camera in cameras[own]]] * len(times),
            "cam_id": [list(range(len(films)))[own]] * len(times),
        }
        (folder / file).write_text(json.dumps({"w": width, "h": height, **table}), encoding="utf-8")
    return [own[time] for own in pictures for time in times]


def common_times(cameras: Sequence[dict[int, Picture]]) -> list[int]:
    """The numbers of the spans of time of which all cameras have a picture, in order. Raises InputError."""
    if shared := sorted(set.intersection(*map(set, cameras))):
        return shared
    raise InputError(f"the {len(cameras)} films have no time in common; cut them to begin together.")


def _assigned(films: Sequence[Film], calibration: Path) -> list[Calibrated]:
    """The camera of each film, by its name, else by the order. Raises InputError."""
    cameras = read_calibration(calibration)
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
