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
from lapgs_wgpu.data.json_fields import finite, kind, read_json, required, vector
from lapgs_wgpu.data.poses import LARGEST_ENTRY, OPENGL_TO_OPENCV, world_to_camera
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import rotation_matrix

NEEDED = "which an export of Record3D needs"
LAYOUTS = (("metadata.json", "rgb"), ("metadata", "rgbd"), ("metadata.json", "rgbd"))
AXES = "poses must be camera to world in ARKit's axes (y up, z backward)"
UNIT = 1e-2  # largest deviation of a quaternion's length from 1
LARGEST_SIDE = 1e5  # pixels


def _layout(folder: Path) -> tuple[Path, Path] | None:
    """The file of the metadata, and the folder of the images."""
    for metadata, images in LAYOUTS:
        if (folder / metadata).is_file() and any((folder / images / f"0{suffix}").is_file() for suffix in SUFFIXES):
            return folder / metadata, folder / images
    return None


def _matches(folder: Path) -> bool:
    return _layout(folder) is not None


def _read(folder: Path, image_size: int | None) -> Capture:
    found = _layout(folder)
    assert found is not None
    path, images = found
    data = read_json(path, "poses and K")
    files = {int(file.stem): file for file in images.iterdir()
             if file.suffix.lower() in SUFFIXES and file.stem.isascii() and file.stem.isdigit()}  # fmt: skip
    poses = _list(data, "poses", path)
    if max(files) >= len(poses):
        raise InputError(
            f"{path} has {len(poses)} poses, but there is {files[max(files)]}; frame i needs the pose i: export again."
        )
    width, height = (finite(required(data, name, path, NEEDED), name, path) for name in ("w", "h"))
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"{path}: w and h must be 1 to {LARGEST_SIDE:g} pixels, got {width:g} and {height:g}.")
    lenses: dict[tuple[float, ...], Lens] = {}
    frames = []
    for index, file in sorted(files.items()):
        where = f"{path}, frame {index}"
        values = _intrinsics(data, index, len(poses), path)
        if values not in lenses:
            fx, fy, cx, cy = values
            lenses[values] = Lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), round(width), round(height))
        frames.append(
            Frame(
                check_image(file),
                lenses[values],
                _pose(poses[index], where),
                where,
                ImageName(f"{images.name}/{file.name}"),
                _time(data, index, len(poses), path),
            )
        )
    warnings = []
    if len(files) < len(poses):
        warnings.append(f"{images} holds {len(files)} images for {len(poses)} poses; the other poses are left out.")
    times = "frameTimestamps" if data.get("frameTimestamps") else "fps"
    return Capture(
        frames,
        None,
        source=path,
        time_source=f"{times} in {path}",
        warnings=warnings,
        own_footage=True,
        axes_hint=AXES,
    )


def _list(data: dict[str, Any], name: str, path: Path, count: int | None = None) -> list[Any]:
    """A field that is a list, of `count` entries if that is given."""
    value = required(data, name, path, NEEDED)
    if not isinstance(value, list) or not value or (count is not None and len(value) != count):
        raise InputError(f"{path}: {name} must be a list of {count or 'one entry'} for the frames, got {kind(value)}.")
    return value


def _pose(value: Any, where: str) -> np.ndarray:
    x, y, z, w, *position = vector(value, 7, "the pose", where)
    length = float(np.linalg.norm([x, y, z, w]))
    if abs(length - 1) > UNIT or np.abs(position).max() > LARGEST_ENTRY:
        raise InputError(
            f"{where}: the pose must be a quaternion of length 1 and a position of at most {LARGEST_ENTRY:g}, got the "
            f"length {length:.4g} and {', '.join(f'{each:g}' for each in position)}."
        )
    R_world_cam = rotation_matrix(np.array([w, x, y, z]) / length)
    return world_to_camera(R_world_cam @ OPENGL_TO_OPENCV, np.array(position))


def _intrinsics(data: dict[str, Any], index: int, count: int, path: Path) -> tuple[float, ...]:
    """fx, fy, cx, cy of a frame."""
    if data.get("perFrameIntrinsicCoeffs"):
        each = _list(data, "perFrameIntrinsicCoeffs", path, count)
        return tuple(vector(each[index], 4, "perFrameIntrinsicCoeffs", f"{path}, frame {index}").tolist())
    K = vector(required(data, "K", path, NEEDED), 9, "K", path)
    return tuple(K[[0, 4, 6, 7]].tolist())  # column by column


def _time(data: dict[str, Any], index: int, count: int, path: Path) -> float:
    """Seconds."""
    if data.get("frameTimestamps"):
        return finite(_list(data, "frameTimestamps", path, count)[index], "frameTimestamps", path)
    rate = finite(required(data, "fps", path, NEEDED), "fps", path)
    if not 0 < rate <= LARGEST_SIDE:
        raise InputError(f"{path}: fps must be above 0, got {rate:g}.")
    return index / rate


READER = Reader("Record3D", "metadata.json beside rgb/0.jpg", _matches, _read)
