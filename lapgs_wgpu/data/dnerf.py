"""Scenes in the D-NeRF layout: transforms_train.json and transforms_test.json beside 8-bit PNG (or JPEG) pictures.

Everything that can be checked without decoding a picture is checked when the scene is opened, before any training.
"""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.fields import kind, leads_out, number, read_json, required
from lapgs_wgpu.data.pictures import PICTURE_SUFFIXES, check_pictures, read_picture, shrunk
from lapgs_wgpu.data.poses import LARGEST_ENTRY, ROTATION_TOLERANCE, check_rotation, world_to_camera
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, z backward -> y down, z forward
NEEDED = "which a D-NeRF scene needs"


class _Frame(NamedTuple):
    picture: Path
    T_cam_world: NDArray[np.float64]
    time: float


def is_dnerf(folder: str | Path) -> bool:
    """Whether a folder looks like a D-NeRF scene."""
    return any((Path(folder) / f"transforms_{split}.json").is_file() for split in ("train", "test"))


def load_dnerf(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a D-NeRF scene; pictures are decoded later, view by view.

    image_size: longer side in pixels to which pictures are shrunk by averaging; None keeps them as they are.
    The training views come from transforms_train.json alone and the test views from transforms_test.json alone;
    transforms_val.json is not read. Frames without `time` are taken as evenly spaced over the clip.
    Raises InputError, naming file, frame and field, where the scene cannot be trained on as it stands.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {problem}; give the folder that holds transforms_train.json.")
    train_fov, train = _read_split(folder, "train")
    test_fov, test = _read_split(folder, "test")

    stored = check_pictures([frame.picture for frame in train + test])
    size = shrunk(stored, image_size)

    def views(split: str, fov_x: float, frames: list[_Frame]) -> tuple[View, ...]:
        # camera_angle_x is the horizontal field of view, and pixels are square: one focal length serves both axes.
        focal = 0.5 * stored[0] / math.tan(0.5 * fov_x)
        K = np.array([[focal, 0, stored[0] / 2], [0, focal, stored[1] / 2], [0, 0, 1]])
        return tuple(
            View(
                name=f"{split}_{index:03d}",
                camera=Camera(K, frame.T_cam_world, *stored).resized(*size),
                time=frame.time,
                source=str(frame.picture),
                pixels=partial(read_picture, frame.picture, size),
            )
            for index, frame in enumerate(frames)
        )

    return Dataset(folder.resolve().name, views("train", train_fov, train), views("test", test_fov, test))


def _read_split(folder: Path, split: str) -> tuple[float, list[_Frame]]:
    """One transforms file: the horizontal field of view in radians, and the frames."""
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise InputError(f"{path} does not exist; a D-NeRF scene needs transforms_train.json and transforms_test.json.")
    data = read_json(path, "camera_angle_x and frames")
    fov_x = number(required(data, "camera_angle_x", path, NEEDED), "camera_angle_x", path)
    if not 1e-6 < fov_x < math.pi:
        raise InputError(f"{path}: camera_angle_x must be an angle in radians between 0 and pi, got {fov_x:g}.")
    frames = required(data, "frames", path, NEEDED)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames must be a list of at least one frame, got {kind(frames)}.")

    timed = sum(isinstance(frame, dict) and "time" in frame for frame in frames)
    parsed = []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        if not isinstance(frame, dict):
            raise InputError(f"{where} must be a JSON object, got {kind(frame)}.")
        file_path = required(frame, "file_path", where, NEEDED)
        if not isinstance(file_path, str) or not file_path:
            raise InputError(f"{where}: file_path must be the path of a picture, got {kind(file_path)}.")
        suffix = "" if file_path.lower().endswith(PICTURE_SUFFIXES) else ".png"
        if leads_out(file_path):
            raise InputError(
                f"{where}: file_path {kind(file_path)} leads out of the scene's folder; put the pictures, or a link to "
                "them, into it."
            )
        picture = folder / (file_path + suffix)
        if not os.path.isfile(picture):  # Path.is_file raises where a name is too long
            raise InputError(f"{picture} does not exist, but {where} names it as its file_path.")
        T_cam_world = _world_to_camera(required(frame, "transform_matrix", where, NEEDED), where)
        if timed == 0:
            time = index / max(len(frames) - 1, 1)
        else:
            hint = f"though {timed} of {len(frames)} frames have it; give it for all frames or for none"
            time = number(required(frame, "time", where, hint), "time", where)
            if not 0 <= time <= 1:
                raise InputError(f"{where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        parsed.append(_Frame(picture, T_cam_world, time))
    return fov_x, parsed


def _world_to_camera(value: Any, where: str) -> NDArray[np.float64]:
    """(4, 4) T_cam_world in OpenCV axes from a camera-to-world matrix in OpenGL axes, checked to be a rigid motion."""
    name = f"{where}: transform_matrix"
    rows = value if isinstance(value, list) else []
    if len(rows) != 4 or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(f"{name} must be 4 rows of 4 numbers, got {kind(value)}.")
    T = np.array([[number(entry, "transform_matrix", where) for entry in row] for row in rows])
    bad = np.argwhere(~(np.abs(T) <= LARGEST_ENTRY))  # so written, NaN is bad too
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{name} holds {T[row, column]:g} in row {row}, column {column}; "
            f"its entries must be finite and at most {LARGEST_ENTRY:g}."
        )
    if np.abs(T[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        raise InputError(f"{name} must end with the row 0 0 0 1, got {' '.join(f'{x:g}' for x in T[3])}.")
    R, position = T[:3, :3], T[:3, 3]
    check_rotation(R, name)
    return world_to_camera(R @ OPENGL_TO_OPENCV[:3, :3], position)
