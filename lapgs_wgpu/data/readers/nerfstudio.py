"""Reader of the nerfstudio format: one transforms.json with intrinsics, pose and time of each image.

docs/data.md lists the fields. The cloud of ply_file_path is in the coordinates of transform_matrix: applied_transform
was applied to both. Apps that write ARKit's or ARCore's poses in this form state `timestamp` instead of `time`, and
some leave out the images' suffix .png (NeRFCapture).
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lapgs_wgpu.data.cloud import read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.json_fields import check_inside, finite, image_path, kind, read_json, required
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError

from .transforms import frame_entries, intrinsics

NEEDED = "which a capture in nerfstudio's layout needs"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
PINHOLE = ("w", "h", "fl_x", "fl_y", "cx", "cy")  # fields of a camera without distortion
AXES = "transform_matrix must be camera to world in OpenGL's axes (y up, z backward), and it may be in OpenCV's"


def _matches(folder: Path) -> bool:
    return (folder / "transforms.json").is_file()


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / "transforms.json"
    data = read_json(path, "frames and the camera's fl_x")
    frames: list[Frame] = []
    lenses: dict[tuple[tuple[str, float], ...], Lens] = {}
    poses: dict[bytes, np.ndarray] = {}
    entries = data.get("frames")
    timed = isinstance(entries, list) and any(isinstance(entry, dict) and "time" in entry for entry in entries)
    field = "time" if timed else "timestamp"
    for entry, where, stated in frame_entries(data, path, NEEDED, field):
        name_in_file, file = image_path(entry, folder, where, NEEDED, suffix=".png")
        values = _intrinsics(entry, data, where, path)
        lens = lenses.setdefault(tuple(values.items()), _lens(values))
        T_cam_world = opengl_pose(required(entry, "transform_matrix", where, NEEDED), where)
        T_cam_world = poses.setdefault(T_cam_world.tobytes(), T_cam_world)  # equal poses share the camera
        time = None if stated is None else finite(stated, field, where)
        normal = PurePosixPath(name_in_file)
        name = ImageName(str(normal), str(normal.parent))
        frames.append(Frame(check_image(file), lens, T_cam_world, where, name, time))
    names = [frame.name.file for frame in frames]
    if len(set(names)) < len(names):
        twice = next(name for i, name in enumerate(names) if name in names[:i])
        raise InputError(f"{path}: {len(names)} frames name {len(set(names))} images; {twice} is there twice.")
    tested = _tested(data, names, path)
    if tested is not None:
        frames = [
            dataclasses.replace(frame, split="test" if frame.name.file in tested else "train") for frame in frames
        ]
    cloud = _cloud_file(data, folder, path)
    return Capture(
        frames,
        None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        time_source=f"{field} in {path}",
        own_footage=True,
        axes_hint=AXES,
    )


def _cloud_file(data: dict[str, Any], folder: Path, path: Path) -> Path | None:
    ply = data.get("ply_file_path")
    if ply is None:
        return None
    if isinstance(ply, str):
        check_inside(ply, "ply_file_path", path)
    if not isinstance(ply, str) or not os.path.isfile(folder / ply):
        raise InputError(
            f"{folder / ply if isinstance(ply, str) else kind(ply)} does not exist, but {path} names it as its "
            "ply_file_path; without that field, the capture opens."
        )
    return folder / ply


def _intrinsics(entry: dict[str, Any], shared: dict[str, Any], where: str, path: Path) -> dict[str, float]:
    """The fields of a pinhole camera, which are required, and those of its distortion. Raises InputError."""
    model = entry.get("camera_model", shared.get("camera_model", "OPENCV"))
    if model not in MODELS:
        raise InputError(
            f"{where}: camera_model {kind(model)} is not among those that are read ({', '.join(MODELS)}); undistort "
            "the images first."
        )
    values: dict[str, float] = intrinsics(entry, shared, where, path)
    for name in PINHOLE:
        required(values, name, f"{where} and the file", NEEDED)
    return values


def _lens(values: dict[str, float]) -> Lens:
    width, height, fx, fy, cx, cy = (values[name] for name in PINHOLE)
    k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Lens(K, int(width), int(height), (k1, k2, k3), (p1, p2))


def _tested(data: dict[str, Any], names: list[str], path: Path) -> set[str] | None:
    """The names of the test images that the file states (test_filenames, else val_filenames); None without."""
    for field in ("test_filenames", "val_filenames"):
        listed = data.get(field)
        if not listed:
            continue
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{path}: {field} must be a list of names, got {kind(listed)}.")
        tested = {str(PurePosixPath(name)): name for name in listed}
        unknown = [name for normal, name in tested.items() if normal not in names]
        if unknown:
            raise InputError(f"{path}: {field} names {unknown[0][:80]}, which is none of its {len(names)} frames.")
        return set(tested)
    return None


READER = Reader("nerfstudio", "transforms.json", _matches, _read)
