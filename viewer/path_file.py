"""Camera paths as files: nerfstudio's camera_path.json, whose `render_time` is the time in the clip. Of its two lists
`camera_path` has every frame, and `keyframes`, which is not used, what its editor needs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.data.json_fields import Fields, read_json
from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV
from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose


class PathFile(NamedTuple):
    """A path and its video. size: (width, height). fps: images a second."""

    path: CameraPath
    size: tuple[int, int]
    fps: float


def write_path(file: Path, held: PathFile) -> None:
    """Write a camera path, frame by frame. Atomic. Raises InputError where it cannot be written."""
    width, height = held.size
    count = max(1, round(held.fps * held.path.seconds) + 1)
    frames = [held.path.at(i / held.fps) for i in range(count)]
    values = {
        "camera_type": "perspective",
        "render_height": height,
        "render_width": width,
        "fps": held.fps,
        "seconds": held.path.seconds,
        "camera_path": [
            {
                "camera_to_world": _matrix(pose),
                "fov": math.degrees(pose.fov_y),
                "aspect": width / height,
                "render_time": time,
            }
            for pose, time in frames
        ],
    }
    with atomic_write(file) as target:
        target.write((json.dumps(values, indent=1) + "\n").encode())


def _matrix(pose: Pose) -> list[float]:
    """Write camera to world in OpenGL's axes, 16 numbers row by row."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (OPENGL_TO_OPENCV @ pose.rotation).T, pose.position
    values: list[float] = matrix.ravel().tolist()
    return values


def read_path(file: Path) -> PathFile:
    """Read the frames of a camera path as its key-frames.

    Files without times play the clip once along the path. Raises InputError, which names the file and the field.
    """
    fields = read_json(file)
    kind = fields.values.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"{file}: camera_type is {shown(kind)}; only perspective cameras can be drawn.")
    fps = fields.number("fps", 0.1, 1000.0) if "fps" in fields else 30.0
    frames = fields.objects("camera_path", "frame")
    keys = [_key_frame(frame, i / fps, i / max(1, len(frames) - 1)) for i, frame in enumerate(frames)]
    return PathFile(CameraPath(keys), (fields.side("render_width"), fields.side("render_height")), fps)


def _key_frame(frame: Fields, second: float, share: float) -> KeyFrame:
    """share: of the path that lies before it, which is its time where it has none."""
    from scipy.spatial.transform import Rotation

    named = next((name for name in ("render_time", "time") if name in frame), None)
    time = share if named is None else frame.number(named, 0.0, 1.0)
    world = frame.vector("camera_to_world", 16).reshape(4, 4)
    turn = world[:3, :3] / max(float(np.linalg.norm(world[:3, 0])), 1e-12)
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise InputError(f"{frame.where}: camera_to_world is not a rotation and a position.")
    rotation = OPENGL_TO_OPENCV @ Rotation.from_matrix(turn).as_matrix().T  # exactly a rotation; files are rounded
    return KeyFrame(second, time, Pose(world[:3, 3].copy(), rotation, math.radians(frame.number("fov", 0.1, 179.0))))
