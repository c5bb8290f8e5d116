"""Reader of COLMAP's sparse models: sparse/ or sparse/N (`colmap_model`) beside the images in images/.

Each folder below images/ is a camera, or a time (`stamps`). If the model places each of several cameras at one point,
they do not move, and images of a camera that have no pose have that of its first one.
"""

from pathlib import Path

from lapgs_wgpu.data.capture_files import CaptureFiles, files_below
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.poses import place_of
from lapgs_wgpu.data.readers.colmap_model import ColmapImage, ColmapModel, is_model, read_model
from lapgs_wgpu.data.stamps import image_names, natural_key, stand_still
from lapgs_wgpu.errors import InputError

IMAGES, SPARSE = "images", "sparse"


def _read(folder: Path, image_size: int | None) -> Capture:
    images = folder / IMAGES
    if not images.is_dir():  # only smaller ones may be there, in images_2, images_4, ...
        images = next(iter(sorted(folder.glob(f"{IMAGES}_*"), key=lambda path: natural_key(path.name))), images)
    if not images.is_dir():
        raise InputError(f"{images} does not exist; put the images from which COLMAP made {folder / SPARSE} there.")
    models = {path: read_model(path) for path in _models(folder)}
    chosen, model = max(models.items(), key=lambda item: len(item[1].images))  # the first of equal ones
    if not model.images:
        raise InputError(f"{chosen} holds no image with a pose; let COLMAP register the images again.")
    frames, warnings, left_out = _frames(model, images)
    if len(models) > 1:
        sizes = ", ".join(f"{path.name} with {len(other.images)}" for path, other in models.items())
        warnings.append(f"{folder / SPARSE} holds {len(models)} models ({sizes} images): {chosen.name} is taken.")
    if model.cloud is None:
        warnings.append(
            f"{model.points_file} holds 0 points, so Gaussians start at random depths; points make it train better."
        )
    return Capture(
        frames,
        model.points_file,
        model.cloud,
        warnings=warnings,
        left_out=left_out,
        shares_cameras=True,
        own_footage=True,
    )


def _models(folder: Path) -> list[Path]:
    """The folders of models: sparse itself, else sparse/0, sparse/1, ..."""
    sparse = folder / SPARSE
    if is_model(sparse):
        return [sparse]
    return sorted((path for path in sparse.glob("*") if is_model(path)), key=lambda path: natural_key(path.name))


def _frames(model: ColmapModel, images: Path) -> tuple[list[Frame], list[str], int]:
    """Return the images with a pose, their own or that of their still camera; warnings about files without a pose and
    poses without a file, and how many these are."""
    files = [name for name in files_below(images) if name.lower().endswith(SUFFIXES)]
    finder, existing, registered = CaptureFiles(images), set(files), dict[str, ColmapImage]()
    for image in sorted(model.images, key=lambda image: image.name not in existing):
        found = finder.find_image(image.name, f"{image.where} names it")
        if found is not None and registered.setdefault(found, image) is not image:  # another image's file
            finder.absent.append(f"{images / image.name} does not exist, but {image.where} names it")
    warnings = finder.left_out(len(model.images), model.images_file)
    places = {file: place_of(image.T_cam_world) for file, image in registered.items()}
    names = image_names(files, places)
    first = {name.camera: registered[name.file] for name in reversed(names) if name.file in registered}
    still = first if stand_still(names, places) else {}
    frames: list[Frame] = []
    left_out: list[str] = []
    for name in names:
        if posed := registered.get(name.file) or still.get(name.camera):
            lens, where = model.cameras[posed.camera], f"{model.cameras_file}, camera {posed.camera},"
            frames.append(Frame(check_image(images / name.file), lens, posed.T_cam_world, where, name))
        else:
            left_out.append(name.file)
    if left_out:
        warnings.append(
            f"{len(left_out)} of {len(files)} images below {images} are left out, such as {left_out[0]}: "
            f"{model.images_file} holds no pose for them."
        )
    return frames, warnings, len(left_out) + len(finder.absent)


READERS = (Reader("COLMAP", "sparse/0/cameras.bin or .txt beside images/", lambda f: bool(_models(f)), _read),)
