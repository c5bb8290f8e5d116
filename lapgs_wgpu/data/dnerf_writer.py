"""Writing generated scenes in the D-NeRF layout: a folder that appears whole, and is reused by the same arguments."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera


def split_times(train_times: int, test_times: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Training times (train_times,) evenly spaced over [0, 1], and test times (test_times,), each halfway between two
    of them and spread over the clip."""
    train = np.linspace(0, 1, train_times)
    test = (np.floor((np.arange(test_times) + 0.5) / test_times * (train_times - 1)) + 0.5) / (train_times - 1)
    return train, test


def frame_name(split: str, index: int) -> str:
    """Path of a frame's image in the folder, without its suffix."""
    return f"{split}/r_{index:03d}"


def write_transforms(
    folder: Path, split: str, cameras: Sequence[Camera], times: NDArray[np.float64], fov_x: float
) -> None:
    """Write transforms_SPLIT.json. fov_x: horizontal field of view of all cameras, radians."""
    frames = []
    for index, (camera, time) in enumerate(zip(cameras, times, strict=True)):
        T_world_cam = np.eye(4)
        T_world_cam[:3, :3] = camera.T_cam_world[:3, :3].T * [1, -1, -1]  # OpenGL's axes: y up, z backward
        T_world_cam[:3, 3] = camera.position
        name = f"./{frame_name(split, index)}"
        frames.append({"file_path": name, "time": time, "transform_matrix": T_world_cam.tolist()})
    data = {"camera_angle_x": fov_x, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(data, indent=1) + "\n")


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to fill, which takes the name `folder` when the block ends without an exception.

    `folder` must not exist, or be empty. Errors of the file system are raised as InputError.
    """
    unfinished = folder.with_name(f"{folder.name}.{os.getpid()}.partial")
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        if folder.is_dir():
            folder.rmdir()  # it is empty
        unfinished.rename(folder)
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error}.") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def already_holds(folder: Path, record: str, parameters: Mapping[str, object]) -> bool:
    """Whether a folder holds the scene of these parameters, which its JSON file `record` stores at the top level.

    Raises InputError where the folder holds anything else.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        found = json.loads((folder / record).read_text())
    except (OSError, ValueError):
        found = None
    what = "is not empty"
    if isinstance(found, dict):
        other = [
            f"{key} {found.get(key)} instead of {value}" for key, value in parameters.items() if found.get(key) != value
        ]
        if not other:
            return True
        what = f"holds another built-in scene ({', '.join(other)})"
    raise InputError(
        f"{folder} {what} and is left alone; name another folder for the built-in scene, or remove this one."
    )
