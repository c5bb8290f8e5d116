"""Readers of what apps export: Record3D, and Polycam's raw data. Poses are in meters and ARKit's axes, as OpenGL's.

docs/data.md lists the fields. Polycam's optimizer writes corrected_cameras/ (and, where it removes a distortion,
corrected_images/), which are preferred to cameras/ and images/. Depth maps and the mesh are not read.
"""

from pathlib import Path

import numpy as np

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.json_fields import LARGEST_INTRINSIC, matrix, number, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV, opengl_pose, unit_quaternion, world_to_camera
from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed
from lapgs_wgpu.splat.camera import rotation_matrix


def _record3d_layout(folder: Path) -> tuple[Path, Path] | None:
    """Return the file of the metadata and the folder of the images; None if there are none."""
    for metadata, images in (("metadata.json", "rgb"), ("metadata", "rgbd"), ("metadata.json", "rgbd")):
        if (folder / metadata).is_file() and any((folder / images / f"0{suffix}").is_file() for suffix in SUFFIXES):
            return folder / metadata, folder / images
    return None


def _read_record3d(folder: Path, image_size: int | None) -> Capture:
    layout = _record3d_layout(folder)
    assert layout is not None
    path, images = layout
    data = read_json(path)
    pictures = [file for file in listed(images) if file.suffix.lower() in SUFFIXES]
    files = {int(file.stem): file for file in pictures if file.stem.isascii() and file.stem.isdigit()}
    poses = data.entries("poses")
    if max(files) >= len(poses):
        raise InputError(f"{path} has {len(poses)} poses, but there is {files[max(files)]}; export them again.")
    if data.values.get(timed := "frameTimestamps"):
        times = data.entries(timed, len(poses))
    else:
        timed, rate = "fps", data.number("fps", 1e-9, 1e5)
        times = [index / rate for index in range(len(poses))]
    if data.values.get("perFrameIntrinsicCoeffs"):
        intrinsics = data.entries("perFrameIntrinsicCoeffs", len(poses))
    else:
        intrinsics = [data.vector("K", 9)[[0, 4, 6, 7]].tolist()] * len(poses)  # K is stored column by column
    width, height = data.side("w"), data.side("h")
    frames = []
    for index, file in sorted(files.items()):
        where = f"{path}, frame {index}"
        fx, fy, cx, cy = matrix(intrinsics[index], (4,), "perFrameIntrinsicCoeffs", where).tolist()
        x, y, z, w, *position = matrix(poses[index], (7,), "poses", where)
        R_world_cam = rotation_matrix(unit_quaternion(np.array([w, x, y, z]), where))
        frames.append(
            Frame(
                check_image(file),
                Lens(width, height, fx, fy, cx, cy),
                world_to_camera(R_world_cam @ OPENGL_TO_OPENCV, np.array(position)),
                where,
                ImageName(f"{images.name}/{file.name}"),
                number(times[index], timed, where),
            )
        )
    absent = len(poses) - len(files)
    warnings = [f"{images} holds {len(files)} images for {len(poses)} poses; the other poses are left out."]
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
        name = files.find_image(path.stem, f"{path} describes its camera")
        if name is None:
            continue
        data = read_json(path)
        fx, fy, cx, cy = (data.number(k, -LARGEST_INTRINSIC, LARGEST_INTRINSIC) for k in ("fx", "fy", "cx", "cy"))
        rows = [[data.required(f"t_{i}{j}") for j in range(4)] for i in range(3)]
        frames.append(
            Frame(
                check_image(images / name),
                Lens(data.side("width"), data.side("height"), fx, fy, cx, cy),
                opengl_pose(rows, str(path)),
                str(path),
                ImageName(name),
                data.number("timestamp", -1e18, 1e18),
            )
        )
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
    Reader("Record3D", "metadata.json beside rgb/0.jpg", lambda f: _record3d_layout(f) is not None, _read_record3d),
    Reader("Polycam", "keyframes/cameras/*.json", lambda f: _subfolder(f, "cameras").is_dir(), _read_polycam),
)
