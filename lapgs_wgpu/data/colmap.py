"""Captures of one's own: a sparse model of COLMAP in sparse/ beside the pictures in images/.

docs/own-data.md says how to make them; docs/data.md what each file holds and what is done with it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.colmap_model import ColmapCamera, ColmapImage, ColmapModel, count_images, is_model, read_model
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.moments import Picture, held_out, natural, time_source, times_of
from lapgs_wgpu.data.pictures import PICTURE_SUFFIXES
from lapgs_wgpu.data.poses import check_rotation
from lapgs_wgpu.data.shots import Shot, dataset_of
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

IMAGES, SPARSE = "images", "sparse"
AXES = "the model is damaged, since COLMAP keeps only points in front of its cameras"


def is_colmap(folder: str | Path) -> bool:
    """Whether a folder looks like a capture with a sparse model."""
    return bool(_models(Path(folder)))


def load_colmap(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a capture with a sparse model; pictures are decoded, and straightened, later, view by view.

    image_size: longer side in pixels to which pictures are shrunk; None keeps them as they are.
    Times and held-out views: `moments`. Where the model holds exactly one picture of each of several cameras' folders,
    these cameras stand still, and the pose of the one is that of all pictures in its folder.
    Cameras and points are moved and scaled together (`poses.fitting`). Raises InputError, naming file and field.
    """
    folder = Path(folder)
    images = folder / IMAGES
    if not images.is_dir():
        raise InputError(f"{images} does not exist; put the pictures from which COLMAP made {folder / SPARSE} there.")
    models = {path: count_images(path) for path in _models(folder)}
    chosen = max(models, key=lambda path: models[path])  # the first of equal ones
    model = read_model(chosen)
    where = chosen / ("cameras.bin" if (chosen / "cameras.bin").is_file() else "cameras.txt")
    if not model.images:
        raise InputError(f"{chosen} holds no picture with a pose; COLMAP could not put the pictures together.")
    there = _pictures(images)
    for image in model.images:
        if image.name not in there:
            raise InputError(f"{images / image.name} does not exist, but {image.where} names it.")

    shots, warnings = _shots(model, images, there, where)
    if len(models) > 1:
        sizes = ", ".join(f"{path.name} with {count}" for path, count in models.items())
        warnings.append(f"{folder / SPARSE} holds {len(models)} models ({sizes} pictures): {chosen.name} is taken.")
    pictures = [shot.picture for shot in shots]
    times, disordered = times_of(pictures, folder)
    if not len(model.points):
        raise InputError(f"{model.points_file} holds 0 points; run COLMAP's mapper, which finds points with the poses.")
    bad = np.flatnonzero(~(np.abs(model.points) <= 1e9).all(axis=1))
    if len(bad):
        raise InputError(
            f"{model.points_file}: {len(bad)} of {len(model.points)} points are not finite, first {bad[0]}."
        )
    return dataset_of(
        folder,
        shots,
        times,
        held_out(pictures, times),
        Cloud(model.points.astype(np.float32), (model.colours / 255).astype(np.float32)),
        cloud_file=model.points_file,
        image_size=image_size,
        axes=AXES,
        warnings=[*warnings, *disordered],
        time_source=time_source(folder),
    )


def _models(folder: Path) -> list[Path]:
    """The folders of models: sparse itself, else sparse/0, sparse/1, ..."""
    sparse = folder / SPARSE
    if is_model(sparse):
        return [sparse]
    return sorted((path for path in sparse.glob("*") if is_model(path)), key=lambda path: natural(path.name))


def _pictures(images: Path) -> dict[str, Path]:
    """All pictures below images/, by their names relative to it."""
    found = {}
    for parent, _, names in os.walk(images):
        for name in names:
            if name.lower().endswith(PICTURE_SUFFIXES):
                path = Path(parent, name)
                found[path.relative_to(images).as_posix()] = path
    return dict(sorted(found.items(), key=lambda item: natural(item[0])))


def _shots(model: ColmapModel, images: Path, there: dict[str, Path], where: Path) -> tuple[list[Shot], list[str]]:
    """The pictures that have a pose, their own or their still camera's, and warnings about those that have none."""
    lenses = {identity: _lens(camera) for identity, camera in model.cameras.items()}
    by_name = {image.name: image for image in model.images}
    by_camera: dict[str, list[ColmapImage]] = {}
    for image in model.images:
        by_camera.setdefault(_camera_of(image.name), []).append(image)
    still = len(by_camera) > 1 and all(len(own) == 1 for own in by_camera.values())
    posed = {image.name: _pose(image, model.cameras[image.camera], lenses[image.camera]) for image in model.images}
    shots = []
    missing: list[str] = []
    for name, path in there.items():
        own = by_camera.get(_camera_of(name), []) if still else []
        found = own[0] if own else by_name.get(name)
        if found is None:
            missing.append(name)
            continue
        shots.append(
            Shot(
                path,
                Picture(name, _camera_of(name)),
                posed[found.name],
                lenses[found.camera],
                f"{where}, camera {found.camera},",
            )
        )
    warnings = []
    if missing:
        warnings.append(
            f"{len(missing)} of {len(there)} pictures below {images} have no pose and are left out, such as "
            f"{missing[0]}: COLMAP could not place them."
        )
    return shots, warnings


def _camera_of(name: str) -> str:
    """Which camera took a picture: the folder it lies in, below images/."""
    return str(PurePosixPath(name).parent)


def _lens(camera: ColmapCamera) -> Lens:
    p = camera.parameters
    f = p.get("f", 0.0)
    K = np.array([[p.get("fx", f), 0, p["cx"]], [0, p.get("fy", f), p["cy"]], [0, 0, 1]])
    radial = np.array([p.get("k1", 0.0), p.get("k2", 0.0), 0.0])
    return Lens(K, radial, np.array([p.get("p1", 0.0), p.get("p2", 0.0)]))


def _pose(image: ColmapImage, camera: ColmapCamera, lens: Lens) -> Camera:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(image.quaternion), image.translation
    check_rotation(T[:3, :3], image.where)
    return Camera(lens.K, T, camera.width, camera.height)


def rotation(quaternion: Sequence[float] | np.ndarray) -> np.ndarray:
    """(3, 3) of a unit quaternion wxyz."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
