"""Reader of the nerfstudio format: one transforms.json with intrinsics, pose and time of each image.

docs/data.md lists the fields. The cloud of ply_file_path is in the coordinates of transform_matrix: applied_transform
was applied to both.
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

NEEDED = "which a capture in nerfstudio's layout needs"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
LARGEST = 1e6  # of a camera's numbers
AXES = "transform_matrix must be camera to world in OpenGL's axes (y up, z backward), and it may be in OpenCV's"

# Fields of a camera; those of a frame override those of the file. Fields without a default are required.
FIELDS: dict[str, float | None] = {
    "w": None, "h": None, "fl_x": None, "fl_y": None, "cx": None, "cy": None,
    "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "p1": 0.0, "p2": 0.0,
}  # fmt: skip


def _matches(folder: Path) -> bool:
    return (folder / "transforms.json").is_file()


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / "transforms.json"
    data = read_json(path, "frames and the camera's fl_x")
    entries = required(data, "frames", path, NEEDED)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: frames must be a list of at least one frame, got {kind(entries)}.")
    timed = sum(isinstance(entry, dict) and "time" in entry for entry in entries)
    frames: list[Frame] = []
    lenses: dict[tuple[float, ...], Lens] = {}
    poses: dict[bytes, np.ndarray] = {}
    for index, entry in enumerate(entries):
        where = f"{path}, frame {index}"
        if not isinstance(entry, dict):
            raise InputError(f"{where} must be a JSON object, got {kind(entry)}.")
        name_in_file, file = image_path(entry, folder, where, NEEDED)
        values = _intrinsics(entry, data, where)
        width, height, fx, fy, cx, cy, k1, k2, k3, _, p1, p2 = values
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        lens = lenses.setdefault(values, Lens(K, int(width), int(height), (k1, k2, k3), (p1, p2)))
        T_cam_world = opengl_pose(required(entry, "transform_matrix", where, NEEDED), where)
        T_cam_world = poses.setdefault(T_cam_world.tobytes(), T_cam_world)  # equal poses share the camera
        time = None
        if timed:
            hint = f"though {timed} of {len(entries)} frames have it; give it for all frames or for none"
            time = finite(required(entry, "time", where, hint), "time", where)
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
        time_source=f"time in {path}",
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


def _intrinsics(entry: dict[str, Any], shared: dict[str, Any], where: str) -> tuple[float, ...]:
    """The values of FIELDS."""
    model = entry.get("camera_model", shared.get("camera_model", "OPENCV"))
    if model not in MODELS:
        raise InputError(
            f"{where}: camera_model {kind(model)} is not among those that are read ({', '.join(MODELS)}); undistort "
            "the images first."
        )
    values = []
    for name, default in FIELDS.items():
        source, at = (entry, where) if name in entry else (shared, f"{where} and the file")
        value = required(source, name, at, NEEDED) if default is None else source.get(name, default)
        got = finite(value, name, where)
        low = 1 if name in ("w", "h") else 0
        positive = name in ("w", "h", "fl_x", "fl_y")
        if abs(got) > LARGEST or (positive and (got <= 0 or got < low)) or (name in ("w", "h") and got > 1e5):
            raise InputError(f"{where}: {name} is {got:g}, which no camera has; it must be in pixels.")
        values.append(got)
    if values[list(FIELDS).index("k4")]:
        raise InputError(
            f"{where}: k4 is {values[9]:g}, and only k1, k2, k3, p1 and p2 are read; undistort the images."
        )
    return tuple(values)


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
