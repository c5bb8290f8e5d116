"""Reader of COLMAP's sparse models: sparse/ or sparse/N (`colmap_model`) beside the images in images/.

Each folder below images/ is a camera, or a time (`stamps`). If the model places each of several cameras at one point,
they do not move, and images of a camera that have no pose have that of its first one. docs/own-data.md says how to make
such a capture.

Models without points, and with a camera for each image, as other programs export them, are read, too.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.image_files import ImageFinder, check_absent
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.json_fields import absent_image
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import check_rotation
from lapgs_wgpu.data.readers.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    is_model,
    read_model,
)
from lapgs_wgpu.data.stamps import image_names
from lapgs_wgpu.data.timestamps import natural_key
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import is_desktop_file
from lapgs_wgpu.splat.camera import rotation_matrix

IMAGES, SPARSE = "images", "sparse"
STILL = 0.02  # of the distance of cameras: the poses of one that stands still are apart by less


def _matches(folder: Path) -> bool:
    return bool(_models(folder))


def _read(folder: Path, image_size: int | None) -> Capture:
    images = folder / IMAGES
    if not images.is_dir():  # only smaller ones may be there, in images_2, images_4, ...
        images = next(iter(sorted(folder.glob(f"{IMAGES}_*"), key=lambda path: natural_key(path.name))), images)
    if not images.is_dir():
        raise InputError(f"{images} does not exist; put the images from which COLMAP made {folder / SPARSE} there.")
    models = {path: read_model(path) for path in _models(folder)}
    chosen, model = max(models.items(), key=lambda item: len(item[1].images))  # the first of equal ones
    if not model.images:
        raise InputError(f"{chosen} holds no image with a pose; COLMAP could not register any.")
    files = _files(images)
    registered, absent = _registered(model, images, files)
    warnings = check_absent(absent, len(model.images), model.images_file)
    frames = _frames(model, registered, images, files, warnings)
    if len(models) > 1:
        sizes = ", ".join(f"{path.name} with {len(other.images)}" for path, other in models.items())
        warnings.append(f"{folder / SPARSE} holds {len(models)} models ({sizes} images): {chosen.name} is taken.")
    cloud = None
    if len(model.points):
        cloud = Cloud(model.points, (model.colors / 255).astype(np.float32))
    else:
        warnings.append(
            f"{model.points_file} holds 0 points, so Gaussians start at random depths before the cameras; a model with "
            "points trains better."
        )
    return Capture(
        frames,
        cloud,
        model.points_file,
        warnings=warnings,
        left_out=len(files) - len(frames) + len(absent),
        shares_cameras=True,
        own_footage=True,
    )


def _models(folder: Path) -> list[Path]:
    """The folders of models: sparse itself, else sparse/0, sparse/1, ..."""
    sparse = folder / SPARSE
    if is_model(sparse):
        return [sparse]
    return sorted((path for path in sparse.glob("*") if is_model(path)), key=lambda path: natural_key(path.name))


def _files(images: Path) -> dict[str, Path]:
    """All image files below images/, by their relative paths."""
    files = {}
    entered: set[str] = set()
    for parent, folders, names in os.walk(images, followlinks=True):
        entered.add(os.path.realpath(parent))
        folders[:] = [name for name in folders if os.path.realpath(os.path.join(parent, name)) not in entered]
        for name in names:
            if name.lower().endswith(SUFFIXES) and not is_desktop_file(name):
                path = Path(parent, name)
                files[path.relative_to(images).as_posix()] = path
    return dict(sorted(files.items(), key=lambda item: natural_key(item[0])))


def _registered(model: ColmapModel, images: Path, files: dict[str, Path]) -> tuple[dict[str, ColmapImage], list[str]]:
    """Return the images of the model by the names of their files, and a sentence about each that has no file."""
    finder = ImageFinder(images)
    by_file, absent = {image.name: image for image in model.images if image.name in files}, []
    for image in model.images:
        if image.name not in files:
            name = finder.find(image.name)
            if name is None or by_file.setdefault(name, image) is not image:
                absent.append(str(absent_image(images / image.name, f"{image.where} names it")))
    return by_file, absent


def _frames(
    model: ColmapModel,
    registered: dict[str, ColmapImage],
    images: Path,
    files: dict[str, Path],
    warnings: list[str],
) -> list[Frame]:
    """Return the images with a pose, their own or that of their still camera. Appends a warning about those without."""
    names = {name.file: name for name in image_names(list(files))}
    by_camera: dict[str, list[ColmapImage]] = {}
    for name, image in registered.items():
        by_camera.setdefault(names[name].camera, []).append(image)
    still_cameras = len(by_camera) > 1 and _stand_still(list(by_camera.values()))
    frames: list[Frame] = []
    left_out: list[str] = []
    for name, path in files.items():
        camera = names[name].camera
        posed = registered.get(name)
        if posed is None and still_cameras and camera in by_camera:
            posed = by_camera[camera][0]
        if posed is None:
            left_out.append(name)
            continue
        entry = f"{model.cameras_file}, camera {posed.camera},"
        lens, pose = _lens(model.cameras[posed.camera]), _pose(posed)
        frames.append(Frame(check_image(path), lens, pose, entry, names[name]))
    if left_out:
        warnings.append(
            f"{len(left_out)} of {len(files)} images below {images} are left out, such as {left_out[0]}: "
            f"{model.images_file} holds no pose for them."
        )
    return frames


def _stand_still(cameras: Sequence[Sequence[ColmapImage]]) -> bool:
    """Whether the registered images of each camera were taken from one place, as exactly as COLMAP finds it."""
    places = [np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in map(_pose, own)]) for own in cameras]
    apart = float(np.ptp(np.concatenate(places), axis=0).max())
    return all(float(np.ptp(own, axis=0).max()) <= STILL * apart for own in places)


def _lens(camera: ColmapCamera) -> Lens:
    p = camera.parameters
    fx, fy = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
    radial, tangential = (p.get("k1", 0.0), p.get("k2", 0.0), 0.0), (p.get("p1", 0.0), p.get("p2", 0.0))
    return Lens(camera.width, camera.height, fx, fy, p["cx"], p["cy"], radial=radial, tangential=tangential)


def _pose(image: ColmapImage) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(image.quaternion), image.translation
    check_rotation(T[:3, :3], image.where)
    return T


READER = Reader("COLMAP", "sparse/0/cameras.bin or .txt beside images/", _matches, _read)
