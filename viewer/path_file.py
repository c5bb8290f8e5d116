"""Camera paths as files: nerfstudio's camera_path.json, whose key `render_time` is the time in the clip."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lapgs_wgpu.data.json_fields import number, read_json, vector
from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV
from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose

_MOST_SECONDS = 24 * 3600.0


class PathFile(NamedTuple):
    """A path and its video. size: (width, height). fps: images a second."""

    path: CameraPath
    size: tuple[int, int]
    fps: float


def write_path(file: Path, held: PathFile) -> None:
    """Write a camera path. Atomic. Raises InputError where it cannot be written."""
    width, height = held.size
    keys = held.path.keys
    waits = [0.0, *np.diff([key.second for key in keys]).tolist()]
    frames = [held.path.at(i / held.fps) for i in range(max(1, int(held.fps * held.path.seconds)))]
    values = {
        "camera_type": "perspective",
        "render_height": height,
        "render_width": width,
        "fps": held.fps,
        "seconds": held.path.seconds,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "default_fov": math.degrees(keys[0].pose.fov_y),
        "default_time": keys[0].time,
        "default_transition_sec": 2.0,
        "keyframes": [
            {
                "matrix": _matrix(key.pose),
                **_lens(key.pose, key.time, width / height),
                "override_time_enabled": True,
                "override_transition_enabled": True,
                "override_transition_sec": wait,
            }
            for key, wait in zip(keys, waits, strict=True)
        ],
        "camera_path": [
            {"camera_to_world": _matrix(pose), **_lens(pose, time, width / height)} for pose, time in frames
        ],
    }
    with atomic_write(file) as target:
        target.write((json.dumps(values, indent=1) + "\n").encode())


def _lens(pose: Pose, time: float, aspect: float) -> dict[str, float]:
    return {"fov": math.degrees(pose.fov_y), "aspect": aspect, "render_time": time}


def _matrix(pose: Pose) -> list[float]:
    """Write camera to world in OpenGL's axes, 16 numbers row by row."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (OPENGL_TO_OPENCV @ pose.rotation).T, pose.position
    values: list[float] = matrix.ravel().tolist()
    return values


def read_path(file: Path) -> PathFile:
    """Read a camera path: its key-frames, or, in files without usable ones, its frames as key-frames.

    Files without times play the clip once along the path. Raises InputError, which names the file and the field.
    """
    values = read_json(file).values
    kind = values.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"{file}: camera_type is {shown(kind)}; only perspective cameras can be drawn.")
    width, height = (int(_within(values, f"render_{side}", 1, 16384, str(file))) for side in ("width", "height"))
    fps = _within(values, "fps", 0.1, 1000.0, str(file), default=30.0)
    keys = values.get("keyframes")
    # nerfstudio's first viewer saved its key-frames as texts; the frames are then what there is.
    if isinstance(keys, list) and keys and all(isinstance(key, dict) and key.get("properties") is None for key in keys):
        found = _key_frames(values, keys, file)
    else:
        frames = values.get("camera_path")
        if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
            raise InputError(f"{file}: holds neither keyframes nor a list of objects as its camera_path.")
        found = [
            _key_frame(i / fps, frame, "camera_to_world", f"{file}: camera_path[{i}]") for i, frame in enumerate(frames)
        ]
    if not all(math.isfinite(key.time) for key in found):
        length = max(found[-1].second, 1e-9)
        found = [key._replace(time=min(key.second / length, 1.0)) for key in found]
    return PathFile(CameraPath(found), (width, height), fps)


def _key_frames(values: dict[str, Any], keys: list[dict[str, Any]], file: Path) -> list[KeyFrame]:
    closed = values.get("is_cycle") is True and len(keys) > 1
    if values.get("default_transition_sec") is not None:
        usual = _within(values, "default_transition_sec", 1e-3, _MOST_SECONDS, str(file))
    else:  # older files say how long the whole path takes
        whole = _within(values, "seconds", 1e-3, _MOST_SECONDS, str(file), default=0.0 if len(keys) == 1 else None)
        usual = whole / max(1, len(keys) - 1 + closed)
    found: list[KeyFrame] = []
    second = back = 0.0  # back: seconds from the last key-frame to the first, where the path is closed
    for i, key in enumerate(keys):
        where, wait = f"{file}: keyframes[{i}]", usual
        if key.get("override_transition_enabled") and key.get("override_transition_sec") is not None:
            wait = _within(key, "override_transition_sec", 1e-3 if i else 0.0, _MOST_SECONDS, where)
        if i:
            second += wait
        else:
            back = wait
        found.append(_key_frame(second, key, "matrix", where))
    if closed and back > 0:
        found.append(found[0]._replace(second=second + back))
    return found


def _key_frame(second: float, entry: dict[str, Any], matrix: str, where: str) -> KeyFrame:
    """Read an entry; its time is NaN where it has none."""
    from scipy.spatial.transform import Rotation

    key = "render_time" if entry.get("render_time") is not None else "time"
    time = _within(entry, key, 0.0, 1.0, where, default=math.nan)
    world = vector(entry.get(matrix), 16, matrix, where).reshape(4, 4)
    turn = world[:3, :3] / max(float(np.linalg.norm(world[:3, 0])), 1e-12)
    if np.abs(world).max() > 1e12 or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise InputError(f"{where}: {matrix} is not a rotation and a position.")
    rotation = OPENGL_TO_OPENCV @ Rotation.from_matrix(turn).as_matrix().T  # exactly a rotation; files are rounded
    fov = math.radians(_within(entry, "fov", 0.1, 179.0, where))
    return KeyFrame(second, time, Pose(world[:3, 3].copy(), rotation, fov))


def _within(
    entry: dict[str, Any], name: str, low: float, high: float, where: str, default: float | None = None
) -> float:
    """Read a number of a table. Raises InputError where it is missing without a default, or outside its range."""
    value = entry.get(name)
    if value is None and default is not None:
        return default
    got = number(value, name, where)
    if not low <= got <= high:
        raise InputError(f"{where}: {name} must be from {low:g} to {high:g}, got {got:g}.")
    return got
