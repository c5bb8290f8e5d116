"""Writing generated scenes in the D-NeRF layout: a folder that appears whole, and is reused by the same arguments."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import encode_png
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import new_folder
from lapgs_wgpu.splat.camera import Camera


def split_times(train_times: int, test_times: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Training times (train_times,) evenly spaced over [0, 1], and test times (test_times,), each halfway between two
    of them and spread over the clip."""
    train = np.linspace(0, 1, train_times)
    test = (np.floor((np.arange(test_times) + 0.5) / test_times * (train_times - 1)) + 0.5) / (train_times - 1)
    return train, test


def write_scene(
    folder: Path,
    record: str,
    parameters: Mapping[str, object],
    splits: Mapping[str, tuple[Sequence[Camera], NDArray[np.float64]]],
    fov_x: float,
    write_frame: Callable[[Path, str, str, Camera, float], None],
    details: Mapping[str, object] | None = None,
) -> Path:
    """Write a scene, unless the folder already holds it; the folder appears only when it is complete. Returns it.

    record: name of a JSON file that stores `parameters`, which identify the scene, and `details`. splits: cameras and
    times of the images of train, val and test. fov_x: horizontal field of view of all cameras, radians. write_frame:
    writes the files of one image, from folder, split, name without suffix, camera and time.
    Raises InputError where the folder holds anything else, and for errors of the file system.
    """
    if _already_holds(folder, record, parameters):
        return folder
    with new_folder(folder) as unfinished:
        for split, (cameras, times) in splits.items():
            frames = []
            for index, (camera, time) in enumerate(zip(cameras, times, strict=True)):
                name = f"r_{index:03d}"
                write_frame(unfinished, split, name, camera, time)
                T_world_cam = np.eye(4)
                T_world_cam[:3, :3] = camera.T_cam_world[:3, :3].T * [1, -1, -1]  # OpenGL's axes: y up, z backward
                T_world_cam[:3, 3] = camera.position
                pose = T_world_cam.tolist()
                frames.append({"file_path": f"./{split}/{name}", "time": time, "transform_matrix": pose})
            _write_json(unfinished / f"transforms_{split}.json", {"camera_angle_x": fov_x, "frames": frames})
        _write_json(unfinished / record, {**parameters, **(details or {})})
    return folder


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a PNG file, and its folder if that is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(image))


def _write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")


def _already_holds(folder: Path, record: str, parameters: Mapping[str, object]) -> bool:
    """Whether a folder holds the scene of these parameters, which its JSON file `record` stores at the top level.

    Raises InputError where the folder holds anything else.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        recorded = json.loads((folder / record).read_text())
    except (OSError, ValueError):
        recorded = None
    what = "is not empty"
    if isinstance(recorded, dict):
        differing = [key for key, value in parameters.items() if recorded.get(key) != value]
        if not differing:
            return True
        named = ", ".join(f"{key} {recorded.get(key)} instead of {parameters[key]}" for key in differing)
        what = f"holds another built-in scene ({named})"
    raise InputError(
        f"{folder} {what} and is left alone; name another folder for the built-in scene, or remove this one."
    )
