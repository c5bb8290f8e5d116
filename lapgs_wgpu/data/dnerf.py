"""Scenes in the D-NeRF layout: transforms_train.json and transforms_test.json beside 8-bit PNG (or JPEG) pictures.

Everything that can be checked without decoding a picture is checked when the scene is opened, before any training.
"""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.fields import check_inside, kind, number, read_json, required
from lapgs_wgpu.data.objects import read_objects
from lapgs_wgpu.data.pictures import PICTURE_SUFFIXES, check_pictures, read_picture, shrunk
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

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
    objects.json, where there is one, says where moving objects are in the test views.
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
        cameras = [Camera(K, frame.T_cam_world, *stored).resized(*size) for frame in frames]
        stems = [frame.picture.stem for frame in frames]
        truths = read_objects(folder, split, stems, cameras) if split == "test" else [[] for _ in frames]
        return tuple(
            View(
                name=f"{split}_{index:03d}",
                camera=camera,
                time=frame.time,
                source=str(frame.picture),
                pixels=partial(read_picture, frame.picture, size),
                objects=tuple(objects),
            )
            for index, (frame, camera, objects) in enumerate(zip(frames, cameras, truths, strict=True))
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
        check_inside(file_path, "file_path", where)
        picture = folder / (file_path + suffix)
        if not os.path.isfile(picture):  # Path.is_file raises where a name is too long
            raise InputError(f"{picture} does not exist, but {where} names it as its file_path.")
        T_cam_world = opengl_pose(required(frame, "transform_matrix", where, NEEDED), where)
        if timed == 0:
            time = index / max(len(frames) - 1, 1)
        else:
            hint = f"though {timed} of {len(frames)} frames have it; give it for all frames or for none"
            time = number(required(frame, "time", where, hint), "time", where)
            if not 0 <= time <= 1:
                raise InputError(f"{where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        parsed.append(_Frame(picture, T_cam_world, time))
    return fov_x, parsed
