"""Readers of what apps export: Record3D, and Polycam's raw data. Poses are in meters and ARKit's axes, as OpenGL's.

docs/data.md lists the fields. Polycam's optimizer writes corrected_cameras/ (and, where it removes a distortion,
corrected_images/), which are preferred to cameras/ and images/. Depth maps and the mesh are not read.
"""

from pathlib import Path

import numpy as np

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.json_fields import FINITE, LARGEST_INTRINSIC, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV, opengl_pose, rotation_of, world_to_camera
from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed


def _record3d_layouts(folder: Path) -> list[tuple[Path, Path]]:
    """The files of metadata beside a folder of images, and these folders."""
    names = (("metadata.json", "rgb"), ("metadata", "rgbd"), ("metadata.json", "rgbd"))
    paths = [(folder / metadata, folder / images) for metadata, images in names if (folder / metadata).is_file()]
    return [found for found in paths if any((found[1] / f"0{suffix}").is_file() for suffix in SUFFIXES)]


def _read_record3d(folder: Path, image_size: int | None) -> Capture:
    path, images = _record3d_layouts(folder)[0]
    data = read_json(path)
    pictures = [file for file in listed(images) if file.suffix.lower() in SUFFIXES]
    files = {int(file.stem): file for file in pictures if file.stem.isascii() and file.stem.isdigit()}
    count = len(data.entries("poses"))
    if max(files) >= count:
        raise InputError(f"{path} has {count} poses, but there is {files[max(files)]}; export them again.")
    optional = [name for name in ("frameTimestamps", "perFrameIntrinsicCoeffs") if data.values.get(name)]
    entries = data.table("frame", "poses", *optional)
    timed = "frameTimestamps" if "frameTimestamps" in optional else "fps"
    size, frames = (data.side("w"), data.side("h")), []
    for index, file in sorted(files.items()):
        entry, where = entries[index], entries[index].where
        if "perFrameIntrinsicCoeffs" in entry:
            K = entry.matrix("perFrameIntrinsicCoeffs", 4)
        else:
            K = data.matrix("K", 9)[[0, 4, 6, 7]]  # which is stored column by column
        x, y, z, w, *position = entry.matrix("poses", 7)
        R_world_cam = rotation_of(np.array([w, x, y, z]), where) @ OPENGL_TO_OPENCV
        pose, name = world_to_camera(R_world_cam, np.array(position)), ImageName(f"{images.name}/{file.name}")
        time = entry.number(timed, *FINITE) if timed in entry else index / data.number("fps", 1e-9, 1e5)
        frames.append(Frame(check_image(file), Lens(*size, *K.tolist()), pose, where, name, time))
    absent = count - len(files)
    warnings = [f"{images} holds {len(files)} images for {count} poses; the other poses are left out."]
    return Capture(
        frames,
        source=path,
        time_source=f"{timed} in {path}",
        warnings=warnings if absent else [],
        left_out=absent,
        own_footage=True,
    )


def _subfolder(folder: Path, name: str) -> Path:
    """Return keyframes/corrected_NAME where it exists, else keyframes/NAME."""
    corrected = folder / "keyframes" / f"corrected_{name}"
    return corrected if corrected.is_dir() else folder / "keyframes" / name


def _read_polycam(folder: Path, image_size: int | None) -> Capture:
    cameras, images = _subfolder(folder, "cameras"), _subfolder(folder, "images")
    if not images.is_dir():
        raise InputError(f"{images} does not exist; export raw data from Polycam again.")
    files = CaptureFiles(images)
    described = sorted((file for file in listed(cameras) if file.suffix == ".json"), key=lambda f: natural_key(f.stem))
    if not described:
        raise InputError(f"{cameras} holds no camera (.json); export raw data from Polycam again.")
    frames = []
    for path in described:
        if name := files.find_image(path.stem, f"{path} describes its camera"):
            data = read_json(path)
            fx, fy, cx, cy = (data.number(k, -LARGEST_INTRINSIC, LARGEST_INTRINSIC) for k in ("fx", "fy", "cx", "cy"))
            lens = Lens(data.side("width"), data.side("height"), fx, fy, cx, cy)
            pose = opengl_pose([[data.required(f"t_{i}{j}") for j in range(4)] for i in range(3)], str(path))
            time = data.number("timestamp", -1e18, 1e18)
            frames.append(Frame(check_image(images / name), lens, pose, str(path), ImageName(name), time))
    warnings = files.left_out(len(described), cameras)
    count = sum(file.suffix.lower() in SUFFIXES for file in listed(images))
    undescribed = count - len(frames)
    if undescribed:
        warnings.append(f"{undescribed} of {count} images in {images} have no camera and are left out.")
    return Capture(
        frames,
        source=cameras,
        time_source=f"timestamp in {cameras}",
        warnings=warnings,
        left_out=undescribed + len(files.absent),
        own_footage=True,
    )


READERS = (
    Reader("Record3D", "metadata.json beside rgb/0.jpg", lambda f: bool(_record3d_layouts(f)), _read_record3d),
    Reader("Polycam", "keyframes/cameras/*.json", lambda f: _subfolder(f, "cameras").is_dir(), _read_polycam),
)
