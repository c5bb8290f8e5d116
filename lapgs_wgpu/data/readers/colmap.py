"""Reader of COLMAP's sparse models: sparse/ or sparse/N (`colmap_model`) beside the images in images/.

Each folder below images/ is a camera. If the model holds exactly one image of each of several cameras, these cameras do
not move, and all images of a camera have the pose of the one. docs/own-data.md says how to make such a capture.

The models that VGGT (a camera for each image) and MegaSaM (no points, a cropped size) export are read, too.
"""

from __future__ import annotations

import math
import os
from pathlib import Path, PurePosixPath

import numpy as np

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, Size, check_image
from lapgs_wgpu.data.json_fields import absent
from lapgs_wgpu.data.poses import check_rotation
from lapgs_wgpu.data.readers.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    count_images,
    is_model,
    read_model,
)
from lapgs_wgpu.data.timestamps import ImageName, natural_key
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import is_desktop_file
from lapgs_wgpu.splat.camera import rotation_matrix

IMAGES, SPARSE = "images", "sparse"
MEGASAM_PIXELS = 384 * 512
AXES = "the model is damaged, since COLMAP keeps only points in front of its cameras"


def _matches(folder: Path) -> bool:
    return bool(_models(folder))


def _read(folder: Path, image_size: int | None) -> Capture:
    images = folder / IMAGES
    if not images.is_dir():
        raise InputError(f"{images} does not exist; put the images from which COLMAP made {folder / SPARSE} there.")
    models = {path: count_images(path) for path in _models(folder)}
    chosen = max(models, key=lambda path: models[path])  # the first of equal ones
    model = read_model(chosen)
    where = chosen / ("cameras.bin" if (chosen / "cameras.bin").is_file() else "cameras.txt")
    if not model.images:
        raise InputError(f"{chosen} holds no image with a pose; COLMAP could not register any.")
    files = _files(images)
    for image in model.images:
        if image.name not in files:
            raise InputError(absent(images / image.name, f"{image.where} names it"))
    frames, warnings = _frames(model, images, files, where)
    if len(models) > 1:
        sizes = ", ".join(f"{path.name} with {count}" for path, count in models.items())
        warnings.append(f"{folder / SPARSE} holds {len(models)} models ({sizes} images): {chosen.name} is taken.")
    if not len(model.points):  # MegaSaM's export has none
        warnings.append(
            f"{model.points_file} holds 0 points, so Gaussians start at random depths before the cameras; a model with "
            "points trains better."
        )
        return Capture(frames, None, model.points_file, warnings=warnings, own_footage=True, axes_hint=AXES)
    bad = np.flatnonzero(~(np.abs(model.points) <= 1e9).all(axis=1))
    if len(bad):
        raise InputError(
            f"{model.points_file}: {len(bad)} of {len(model.points)} points are not finite, first {bad[0]}."
        )
    cloud = Cloud(model.points.astype(np.float32), (model.colors / 255).astype(np.float32))
    return Capture(frames, cloud, model.points_file, warnings=warnings, own_footage=True, axes_hint=AXES)


def _models(folder: Path) -> list[Path]:
    """The folders of models: sparse itself, else sparse/0, sparse/1, ..."""
    sparse = folder / SPARSE
    if is_model(sparse):
        return [sparse]
    return sorted((path for path in sparse.glob("*") if is_model(path)), key=lambda path: natural_key(path.name))


def _files(images: Path) -> dict[str, Path]:
    """All image files below images/, by their relative paths."""
    found = {}
    entered: set[str] = set()
    for parent, folders, names in os.walk(images, followlinks=True):
        entered.add(os.path.realpath(parent))
        folders[:] = [name for name in folders if os.path.realpath(os.path.join(parent, name)) not in entered]
        for name in names:
            if name.lower().endswith(SUFFIXES) and not is_desktop_file(name):
                path = Path(parent, name)
                found[path.relative_to(images).as_posix()] = path
    return dict(sorted(found.items(), key=lambda item: natural_key(item[0])))


def _frames(model: ColmapModel, images: Path, files: dict[str, Path], where: Path) -> tuple[list[Frame], list[str]]:
    """The images with a pose, their own or that of their static camera, and a warning about those without one."""
    lenses: dict[tuple[int, Size], Lens] = {}
    by_name = {image.name: image for image in model.images}
    by_camera: dict[str, list[ColmapImage]] = {}
    for image in model.images:
        by_camera.setdefault(_camera_of(image.name), []).append(image)
    static = len(by_camera) > 1 and all(len(own) == 1 for own in by_camera.values())
    poses = {image.name: _pose(image) for image in model.images}
    frames = []
    missing: list[str] = []
    for name, path in files.items():
        camera = _camera_of(name)
        own = by_camera.get(camera, []) if static else []
        found = own[0] if own else by_name.get(name)
        if found is None:
            missing.append(name)
            continue
        entry = f"{where}, camera {found.camera},"
        checked = check_image(path)
        if (key := (found.camera, checked.size)) not in lenses:
            lenses[key] = _lens(model.cameras[found.camera], checked.size)
        frames.append(Frame(checked, lenses[key], poses[found.name], entry, ImageName(name, camera)))
    warnings = []
    if missing:
        warnings.append(
            f"{len(missing)} of {len(files)} images below {images} have no pose and are left out, such as "
            f"{missing[0]}: COLMAP could not register them."
        )
    return frames, warnings


def _camera_of(name: str) -> str:
    """The camera that took an image: its folder below images/."""
    return str(PurePosixPath(name).parent)


def _lens(camera: ColmapCamera, image: Size) -> Lens:
    """The lens of a camera for images of (width, height)."""
    p = camera.parameters
    f = p.get("f", 0.0)
    K = np.array([[p.get("fx", f), 0, p["cx"]], [0, p.get("fy", f), p["cy"]], [0, 0, 1]])
    radial, tangential = (p.get("k1", 0.0), p.get("k2", 0.0), 0.0), (p.get("p1", 0.0), p.get("p2", 0.0))
    return Lens(K, *_uncropped((camera.width, camera.height), image), radial, tangential)


def _uncropped(stated: Size, image: Size) -> Size:
    """The size at which a camera's parameters hold: the stated one, but with MegaSaM, which shrinks images to some
    384x512 pixels and then cuts off what is left of 8 at the right and at the bottom; its models state what remains."""
    scale = math.sqrt(MEGASAM_PIXELS / (image[0] * image[1]))
    width, height = int(image[0] * scale), int(image[1] * scale)
    return (width, height) if stated == (width - width % 8, height - height % 8) else stated


def _pose(image: ColmapImage) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(image.quaternion), image.translation
    check_rotation(T[:3, :3], image.where)
    return T


READER = Reader("COLMAP", "sparse/0/cameras.bin or .txt beside images/", _matches, _read)
