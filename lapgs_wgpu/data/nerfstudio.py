"""Captures in nerfstudio's layout: one transforms.json with camera, pose and time of each picture.

docs/data.md says which fields are read and what is done with them. Everything but the pixels is checked at opening.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lapgs_wgpu.data.cloud import read_cloud
from lapgs_wgpu.data.fields import check_inside, finite, kind, read_json, required
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.moments import TIMES, Picture, disorder, from_0_to_1, held_out, time_source, times_of
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.shots import Shot, dataset_of
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

NEEDED = "which a capture in nerfstudio's layout needs"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
LARGEST = 1e6  # of a camera's numbers
AXES = "transform_matrix must be camera to world in OpenGL's axes (y up, z backward), and it may be in OpenCV's"

# Fields of a camera, a frame's own before those of the file. Without a default they must be there.
FIELDS: dict[str, float | None] = {
    "w": None, "h": None, "fl_x": None, "fl_y": None, "cx": None, "cy": None,
    "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "p1": 0.0, "p2": 0.0,
}  # fmt: skip


def is_nerfstudio(folder: str | Path) -> bool:
    """Whether a folder looks like a capture in nerfstudio's layout."""
    return (Path(folder) / "transforms.json").is_file()


def load_nerfstudio(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a capture in nerfstudio's layout; pictures are decoded, and straightened, later, view by view.

    image_size: longer side in pixels to which pictures are shrunk; None keeps them as they are.
    The cloud of ply_file_path is in the coordinates of transform_matrix, since applied_transform was applied to both.
    Cameras and points are moved and scaled together (`poses.fitting`). Raises InputError, naming file and field.
    """
    folder = Path(folder)
    path = folder / "transforms.json"
    data = read_json(path, "frames and the camera's fl_x")
    frames = required(data, "frames", path, NEEDED)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames must be a list of at least one frame, got {kind(frames)}.")

    shots = []
    lenses: dict[tuple[float, ...], Lens] = {}
    cameras: dict[tuple[object, ...], Camera] = {}
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        if not isinstance(frame, dict):
            raise InputError(f"{where} must be a JSON object, got {kind(frame)}.")
        name = required(frame, "file_path", where, NEEDED)
        if not isinstance(name, str) or not name:
            raise InputError(f"{where}: file_path must be the path of a picture, got {kind(name)}.")
        check_inside(name, "file_path", where)
        picture = folder / name
        if not os.path.isfile(picture):  # Path.is_file raises where a name is too long
            raise InputError(f"{picture} does not exist, but {where} names it as its file_path.")
        values = _intrinsics(frame, data, where)
        if values not in lenses:
            fx, fy, cx, cy, k1, k2, k3, _, p1, p2 = values[2:]
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            lenses[values] = Lens(K, np.array([k1, k2, k3]), np.array([p1, p2]))
        T_cam_world = opengl_pose(required(frame, "transform_matrix", where, NEEDED), where)
        key = (values, T_cam_world.tobytes())
        if key not in cameras:
            cameras[key] = Camera(lenses[values].K, T_cam_world, int(values[0]), int(values[1]))
        normal = str(PurePosixPath(name))
        shots.append(
            Shot(picture, Picture(normal, str(PurePosixPath(normal).parent)), cameras[key], lenses[values], where)
        )
    names = [shot.picture.name for shot in shots]
    if len(set(names)) < len(names):
        twice = next(name for i, name in enumerate(names) if name in names[:i])
        raise InputError(f"{path}: {len(names)} frames name {len(set(names))} pictures; {twice} is there twice.")

    times, warnings = _times(frames, shots, folder, path)
    cloud_file, cloud = path, None
    if data.get("ply_file_path") is not None:
        ply = data["ply_file_path"]
        if isinstance(ply, str):
            check_inside(ply, "ply_file_path", path)
        if not isinstance(ply, str) or not os.path.isfile(folder / ply):
            raise InputError(
                f"{folder / ply if isinstance(ply, str) else kind(ply)} does not exist, but {path} names it as its "
                "ply_file_path; without that field, the capture opens."
            )
        cloud_file = folder / ply
        cloud = read_cloud(cloud_file)
    return dataset_of(
        folder,
        shots,
        times,
        _tested(data, shots, times, path),
        cloud,
        cloud_file=cloud_file,
        image_size=image_size,
        axes=AXES,
        warnings=warnings,
        time_source=f"time in {path}" if "time" in frames[0] else time_source(folder),
    )


def _intrinsics(frame: dict[str, Any], shared: dict[str, Any], where: str) -> tuple[float, ...]:
    """The values of FIELDS."""
    model = frame.get("camera_model", shared.get("camera_model", "OPENCV"))
    if model not in MODELS:
        raise InputError(
            f"{where}: camera_model {kind(model)} is not among those that are read ({', '.join(MODELS)}); straighten "
            "the pictures first."
        )
    values = []
    for name, default in FIELDS.items():
        source, at = (frame, where) if name in frame else (shared, f"{where} and the file")
        value = required(source, name, at, NEEDED) if default is None else source.get(name, default)
        got = finite(value, name, where)
        low = 1 if name in ("w", "h") else 0
        positive = name in ("w", "h", "fl_x", "fl_y")
        if abs(got) > LARGEST or (positive and (got <= 0 or got < low)) or (name in ("w", "h") and got > 1e5):
            raise InputError(f"{where}: {name} is {got:g}, which no camera has; it must be in pixels.")
        values.append(got)
    if values[list(FIELDS).index("k4")]:
        raise InputError(
            f"{where}: k4 is {values[9]:g}, and only k1, k2, k3, p1 and p2 are read; straighten the pictures."
        )
    return tuple(values)


def _times(frames: list[dict[str, Any]], shots: list[Shot], folder: Path, path: Path) -> tuple[list[float], list[str]]:
    """The time of each frame, first to last from 0 to 1, and warnings."""
    pictures = [shot.picture for shot in shots]
    timed = sum("time" in frame for frame in frames)
    if not timed:
        try:
            return times_of(pictures, folder)
        except InputError as error:
            raise InputError(
                f"{path}: no frame has a time, there is no {TIMES}, and the names do not tell: {error}"
            ) from None
    values = []
    for frame, shot in zip(frames, shots, strict=True):
        hint = f"though {timed} of {len(frames)} frames have it; give it for all frames or for none"
        values.append(finite(required(frame, "time", shot.where, hint), "time", shot.where))
    return from_0_to_1(values), disorder(pictures, values)


def _tested(data: dict[str, Any], shots: list[Shot], times: list[float], path: Path) -> set[int]:
    """The frames that the file holds out (test_filenames, else val_filenames), else those of the rule for all."""
    names = {shot.picture.name: i for i, shot in enumerate(shots)}
    for field in ("test_filenames", "val_filenames"):
        listed = data.get(field)
        if not listed:
            continue
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{path}: {field} must be a list of names, got {kind(listed)}.")
        unknown = [name for name in listed if str(PurePosixPath(name)) not in names]
        if unknown:
            raise InputError(f"{path}: {field} names {unknown[0][:80]}, which is none of its {len(shots)} frames.")
        return {names[str(PurePosixPath(name))] for name in listed}
    return held_out([shot.picture for shot in shots], times)
