"""Reader of Record3D's exports: metadata.json beside rgb/0.jpg, 1.jpg, ..., or an unpacked .r3d: metadata beside rgbd/.

metadata holds, for each frame, `poses` [qx, qy, qz, qw, x, y, z] (camera to world, ARKit's axes, which are OpenGL's, in
meters), `perFrameIntrinsicCoeffs` [fx, fy, cx, cy] or else one `K` (3x3, column by column), both in pixels of images of
`w` x `h`; and `frameTimestamps` in seconds or else `fps`. Depth maps (.exr, .depth) are not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.json_fields import number, read_json, vector
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV, world_to_camera
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import rotation_matrix

UNIT = 1e-2  # largest deviation of a quaternion's length from 1


def _layout(folder: Path) -> tuple[Path, Path] | None:
    """Return the file of the metadata and the folder of the images; None if there are none."""
    for metadata, images in (("metadata.json", "rgb"), ("metadata", "rgbd"), ("metadata.json", "rgbd")):
        if (folder / metadata).is_file() and any((folder / images / f"0{suffix}").is_file() for suffix in SUFFIXES):
            return folder / metadata, folder / images
    return None


def _matches(folder: Path) -> bool:
    return _layout(folder) is not None


def _read(folder: Path, image_size: int | None) -> Capture:
    layout = _layout(folder)
    assert layout is not None
    path, images = layout
    data = read_json(path)
    files = {int(file.stem): file for file in images.iterdir()
             if file.suffix.lower() in SUFFIXES and file.stem.isascii() and file.stem.isdigit()}  # fmt: skip
    poses = data.entries("poses")
    if max(files) >= len(poses):
        raise InputError(
            f"{path} has {len(poses)} poses, but there is {files[max(files)]}; frame i needs the pose i: export again."
        )
    timed = "frameTimestamps" if data.values.get("frameTimestamps") else "fps"
    times = data.entries(timed, len(poses)) if timed == "frameTimestamps" else None
    rate = 1.0 if times is not None else data.number("fps", 1e-9, 1e5)
    if data.values.get("perFrameIntrinsicCoeffs"):
        intrinsics = data.entries("perFrameIntrinsicCoeffs", len(poses))
    else:
        intrinsics = [data.vector("K", 9)[[0, 4, 6, 7]].tolist()] * len(poses)  # K is stored column by column
    width, height = data.side("w"), data.side("h")
    frames = []
    for index, file in sorted(files.items()):
        where = f"{path}, frame {index}"
        fx, fy, cx, cy = vector(intrinsics[index], 4, "perFrameIntrinsicCoeffs", where).tolist()
        time = index / rate if times is None else number(times[index], "frameTimestamps", where)
        frames.append(
            Frame(
                check_image(file),
                Lens(width, height, fx, fy, cx, cy),
                _pose(poses[index], where),
                where,
                ImageName(f"{images.name}/{file.name}"),
                time,
            )
        )
    warnings = []
    if len(files) < len(poses):
        warnings.append(f"{images} holds {len(files)} images for {len(poses)} poses; the other poses are left out.")
    return Capture(
        frames,
        None,
        source=path,
        time_source=f"{timed} in {path}",
        warnings=warnings,
        own_footage=True,
    )


def _pose(value: Any, where: str) -> np.ndarray:
    """Return the (4, 4) pose in OpenCV's axes."""
    x, y, z, w, *position = vector(value, 7, "poses", where)
    length = float(np.linalg.norm([x, y, z, w]))
    if abs(length - 1) > UNIT:
        raise InputError(f"{where}: poses must begin with a quaternion of length 1, got the length {length:.4g}.")
    R_world_cam = rotation_matrix(np.array([w, x, y, z]) / length)
    return world_to_camera(R_world_cam @ OPENGL_TO_OPENCV, np.array(position))


READER = Reader("Record3D", "metadata.json beside rgb/0.jpg", _matches, _read)
