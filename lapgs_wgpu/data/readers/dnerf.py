"""Reader of the D-NeRF format.

transforms_train.json and transforms_test.json hold `camera_angle_x` (horizontal field of view, radians) or intrinsics
(`transforms`; those of a frame override those of the file, and both override the angle), and `frames`:
`file_path` of an image (.png is appended if it has no suffix), `transform_matrix` (camera to world, OpenGL axes) and
`time` in [0, 1], in all frames of a file or in none; frames without times are evenly spaced. transforms_val.json is
optional, and left out with a warning if it is not usable. A cloud is optional:
fused.ply, points3d.ply or points3D.ply.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.cloud import find_cloud, is_random, read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import Size, check_image
from lapgs_wgpu.data.json_fields import image_path, number, read_json, required
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.readers.transforms import frame_entries, intrinsics
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.data.validation import check_frames
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import intrinsics_of_fov

NEEDED = "which a D-NeRF scene needs"
CLOUDS = ("fused.ply", "points3d.ply", "points3D.ply")


def _matches(folder: Path) -> bool:
    return any((folder / f"transforms_{split}.json").is_file() for split in ("train", "test"))


def _read(folder: Path, image_size: int | None) -> Capture:
    frames, warnings = [*_read_split(folder, "train"), *_read_split(folder, "test")], []
    if (folder / "transforms_val.json").is_file():
        try:
            found = _read_split(folder, "val")
            check_frames([frames[0], *found])
            frames += found
        except InputError as error:
            warnings.append(f"the validation views are left out: {error}")
    path = find_cloud(folder, CLOUDS)
    cloud = None if path is None else read_cloud(path)
    if cloud is not None and is_random(cloud):  # other trainers write one, often of 1.3 whatever the scene's size
        cloud = None
    cameras = folder / "transforms_train.json"
    return Capture(
        frames,
        cloud,
        warnings=warnings,
        source=cameras if path is None or cloud is None else path,
        time_source=f"time in {cameras}",
        time_range=(0.0, 1.0),
        keeps_coordinates=True,
    )


def _read_split(folder: Path, split: Split) -> list[Frame]:
    """The frames of one transforms file."""
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise InputError(f"{path} does not exist; a D-NeRF scene needs transforms_train.json and transforms_test.json.")
    data = read_json(path, "camera_angle_x and frames")
    entries = list(frame_entries(data, path, NEEDED))
    frames: list[Frame] = []
    lenses: dict[tuple[float, ...], Lens] = {}
    for index, (entry, where, stated) in enumerate(entries):
        file_path, file = image_path(entry, folder, where, NEEDED, suffix=".png")
        T_cam_world = opengl_pose(required(entry, "transform_matrix", where, NEEDED), where)
        time = index / max(len(entries) - 1, 1) if stated is None else stated
        if not 0 <= time <= 1:
            raise InputError(f"{where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        image = check_image(file)
        lens = _lens(entry, data, image.size, where, path)
        key = (*lens.K.ravel(), lens.width, lens.height, *lens.radial, *lens.tangential)
        lens = lenses.setdefault(key, lens)
        name, label = ImageName(file_path), f"{index:03d}"
        frames.append(Frame(image, lens, T_cam_world, where, name, time=time, split=split, label=label))
    return frames


def _lens(entry: dict[str, Any], shared: dict[str, Any], size: Size, where: str, path: Path) -> Lens:
    """The lens of a frame, at the size that it states, else that of its image, (width, height) `size`."""
    values = intrinsics(entry, shared, where, path)
    width, height = int(values.get("w", size[0])), int(values.get("h", size[1]))
    if "fl_x" in values:
        K = np.array([[values["fl_x"], 0.0, width / 2], [0.0, values["fl_x"], height / 2], [0.0, 0.0, 1.0]])
    else:
        source, at = (entry, where) if "camera_angle_x" in entry else (shared, str(path))
        fov_x = number(required(source, "camera_angle_x", at, NEEDED), "camera_angle_x", at)
        if not 1e-6 < fov_x < math.pi:
            raise InputError(f"{at}: camera_angle_x must be an angle in radians between 0 and pi, got {fov_x:g}.")
        K = intrinsics_of_fov(fov_x, width, height)
    for name, row, column in (("fl_y", 1, 1), ("cx", 0, 2), ("cy", 1, 2)):
        if name in values:
            K[row, column] = values[name]
    k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    return Lens(K, width, height, (k1, k2, k3), (p1, p2))


READER = Reader("D-NeRF", "transforms_train.json and transforms_test.json", _matches, _read)
