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
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.json_fields import check_inside, finite, image_path, kind, read_json, required
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.readers.transforms import frame_entries, intrinsics
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError

NEEDED = "which a capture in nerfstudio's layout needs"
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
        black = _file(entry["mask_path"], "mask_path", folder, where) if entry.get("mask_path") is not None else None
        frames.append(Frame(check_image(file), lens, T_cam_world, where, name, time, black=black))
    names = [frame.name.file for frame in frames]
    if len(set(names)) < len(names):
        twice = next(name for i, name in enumerate(names) if name in names[:i])
        raise InputError(f"{path}: {len(names)} frames name {len(set(names))} images; {twice} is there twice.")
    splits = _splits(data, names, path)
    if splits:
        frames = [
            dataclasses.replace(frame, split=splits[frame.name.file]) for frame in frames if frame.name.file in splits
        ]
    warnings = []
    if len(frames) < len(names):
        left_out = next(name for name in names if name not in splits)
        warnings.append(
            f"{path}: {len(names) - len(frames)} of {len(names)} images, such as {left_out}, are in none of "
            "train_filenames, val_filenames and test_filenames, and are left out."
        )
    ply = data.get("ply_file_path")
    cloud = None if ply is None else _file(ply, "ply_file_path", folder, str(path))
    return Capture(
        frames,
        None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        warnings=warnings,
        time_source=f"{field} in {path}",
        own_footage=True,
        axes_hint=AXES,
    )


def _file(name: Any, field: str, folder: Path, where: str) -> Path:
    """The existing file that an optional field names. Raises InputError."""
    if isinstance(name, str):
        check_inside(name, field, where)
    if not isinstance(name, str) or not os.path.isfile(folder / name):
        raise InputError(
            f"{folder / name if isinstance(name, str) else kind(name)} does not exist, but {where} names it as its "
            f"{field}; without that field, the capture opens."
        )
    return folder / name


def _intrinsics(entry: dict[str, Any], shared: dict[str, Any], where: str, path: Path) -> dict[str, float]:
    """The fields of a pinhole camera, which are required, and those of its distortion. Raises InputError."""
    values: dict[str, float] = intrinsics(entry, shared, where, path)
    for name in PINHOLE:
        required(values, name, f"{where} and the file", NEEDED)
    return values


def _lens(values: dict[str, float]) -> Lens:
    width, height, fx, fy, cx, cy = (values[name] for name in PINHOLE)
    k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Lens(K, int(width), int(height), (k1, k2, k3), (p1, p2))


def _splits(data: dict[str, Any], names: list[str], path: Path) -> dict[str, Split]:
    """The split of each image, as the file's lists state it; {} if they hold nothing out.

    An image in no list is for training, but missing here if the file lists those for training.
    """
    tested, validated = _listed(data, "test_filenames", names, path), _listed(data, "val_filenames", names, path)
    trained = _listed(data, "train_filenames", names, path)
    if not tested:  # one list is enough to measure by
        tested, validated = validated, []
    if not tested:
        return {}
    splits: dict[str, Split] = dict.fromkeys(trained or names, "train")
    return splits | dict.fromkeys(validated, "val") | dict.fromkeys(tested, "test")


def _listed(data: dict[str, Any], field: str, names: list[str], path: Path) -> list[str]:
    """The names of images in a list of the file. Raises InputError, also for one that is no image's."""
    listed = data.get(field) or []
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        raise InputError(f"{path}: {field} must be a list of names, got {kind(listed)}.")
    posix = {name: str(PurePosixPath(name)) for name in listed}
    normal = [posix[name] if posix[name] in names else str(PurePosixPath(name.replace("\\", "/"))) for name in listed]
    unknown = next((name for name in normal if name not in names), None)
    if unknown is not None:
        raise InputError(f"{path}: {field} names {unknown[:80]}, which is none of its {len(names)} frames.")
    return normal


READER = Reader("nerfstudio", "transforms.json", _matches, _read)
