"""Camera paths as files: nerfstudio's camera_path.json, whose key `render_time` is the time in the clip."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.poses import OPENGL_TO_OPENCV
from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.safe_json_toml import read_json
from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose

_MOST_KEYS = 100_000
_MOST_SECONDS = 24 * 3600.0


class PathFile(NamedTuple):
    """size: of the pictures, (width, height). fps: pictures a second."""

    path: CameraPath
    size: tuple[int, int]
    fps: float


def write_path(file: Path, held: PathFile) -> None:
    """Write a camera path. Atomic. Raises InputError where it cannot be written."""
    width, height = held.size
    aspect = width / height
    keys = held.path.keys
    waits = [0.0, *np.diff([key.second for key in keys]).tolist()]
    frames = max(1, int(held.fps * held.path.seconds))
    moments = [held.path.at(number / held.fps) for number in range(frames)]
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
                "fov": math.degrees(key.pose.fov_y),
                "aspect": aspect,
                "render_time": key.time,
                "override_time_enabled": True,
                "override_transition_enabled": True,
                "override_transition_sec": wait,
            }
            for key, wait in zip(keys, waits, strict=True)
        ],
        "camera_path": [
            {
                "camera_to_world": _matrix(pose),
                "fov": math.degrees(pose.fov_y),
                "aspect": aspect,
                "render_time": time,
            }
            for pose, time in moments
        ],
    }
    with atomic_write(file) as target:
        target.write((json.dumps(values, indent=1) + "\n").encode())


def read_path(file: Path) -> PathFile:
    """Read a camera path: its key-frames, or, in files without usable ones, its frames as key-frames.

    Files without times play the clip once along the path. Raises InputError, which names the file and the field.
    """
    values = read_json(file)
    if not isinstance(values, dict):
        raise InputError(f"{file}: holds {type(values).__name__}, not the object of a camera path.")
    return _Reader(file, values).read()


class _Reader:
    def __init__(self, file: Path, values: dict[str, Any]) -> None:
        self.file, self.values = file, values

    def read(self) -> PathFile:
        values = self.values
        kind = values.get("camera_type", "perspective")
        if kind != "perspective":
            raise self.wrong("camera_type", f"is {shown(kind)}; only perspective cameras can be drawn")
        size = tuple(int(self.number(values, f"render_{side}", 1, 16384)) for side in ("width", "height"))
        fps = self.number(values, "fps", 0.1, 1000.0, 30.0)
        keys = values.get("keyframes", [])
        if not isinstance(keys, list):
            raise self.wrong("keyframes", "is not a list")
        # Until 2023 key-frames were saved as a text of the viewer's own; the frames are then what there is.
        if keys and all(isinstance(key, dict) and isinstance(key.get("matrix"), list) for key in keys):
            found = self.key_frames(keys)
        else:
            found = self.frames(fps)
        timed = all(time is not None for _, time, _ in found)
        length = max(found[-1][0], 1e-9)
        return PathFile(
            CameraPath(
                KeyFrame(second, time if timed and time is not None else min(second / length, 1.0), pose)
                for second, time, pose in found
            ),
            (size[0], size[1]),
            fps,
        )

    def key_frames(self, keys: list[Any]) -> list[tuple[float, float | None, Pose]]:
        values = self.values
        usual = self.number(values, "default_transition_sec", 1e-3, _MOST_SECONDS, 0.0)
        told = "default_transition_sec" in values or any("override_transition_sec" in key for key in keys)
        if not told:  # spread over the length that the file names
            steps = max(1, len(keys) - 1 + (values.get("is_cycle") is True))
            usual = self.number(values, "seconds", 1e-3, _MOST_SECONDS) / steps
        found: list[tuple[float, float | None, Pose]] = []
        second = 0.0
        waits = []
        for i, key in enumerate(self.counted(keys, "keyframes")):
            name = f"keyframes[{i}]"
            wait = usual
            if key.get("override_transition_enabled") and key.get("override_transition_sec") is not None:
                # The first one's is only used where the path is closed.
                wait = self.number(key, "override_transition_sec", 1e-3 if i else 0.0, _MOST_SECONDS, where=name)
            if i and wait <= 0:
                raise self.wrong("default_transition_sec", "is missing, and key-frames need it")
            waits.append(wait)
            second += wait if i else 0.0
            found.append((second, self.time(key, name), self.pose(key, "matrix", name)))
        if values.get("is_cycle") is True and len(found) > 1 and waits[0] > 0:
            found.append((second + waits[0], found[0][1], found[0][2]))
        return found

    def frames(self, fps: float) -> list[tuple[float, float | None, Pose]]:
        frames = self.values.get("camera_path")
        if not isinstance(frames, list) or not frames:
            raise self.wrong("camera_path", "is missing or empty, and there are no keyframes")
        found = []
        for i, frame in enumerate(self.counted(frames, "camera_path")):
            name = f"camera_path[{i}]"
            found.append((i / fps, self.time(frame, name), self.pose(frame, "camera_to_world", name)))
        return found

    def counted(self, entries: list[Any], name: str) -> list[dict[str, Any]]:
        if len(entries) > _MOST_KEYS:
            raise self.wrong(name, f"has {len(entries)} entries, over {_MOST_KEYS}")
        for i, entry in enumerate(entries):
            if not isinstance(entry, dict):
                raise self.wrong(f"{name}[{i}]", "is not an object")
        return entries

    def time(self, entry: dict[str, Any], name: str) -> float | None:
        for key in ("render_time", "time"):
            if entry.get(key) is not None:
                return self.number(entry, key, 0.0, 1.0, where=name)
        return None

    def pose(self, entry: dict[str, Any], key: str, name: str) -> Pose:
        field = f"{name}.{key}"
        try:
            matrix: NDArray[np.float64] = np.array(entry.get(key), np.float64).reshape(4, 4)
        except (ValueError, TypeError, OverflowError) as error:
            raise self.wrong(field, "is not a matrix of 4x4 numbers") from error
        turn, scale = matrix[:3, :3], np.linalg.norm(matrix[:3, 0])
        if not np.isfinite(matrix).all() or not 1e-6 < scale < 1e6 or np.abs(matrix).max() > 1e12:
            raise self.wrong(field, "holds numbers that no camera has")
        turn = turn / scale
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
            raise self.wrong(field, "is not a rotation and a position")
        left, _, right = np.linalg.svd(turn)  # rounded in the file; exactly a rotation again
        fov = math.radians(self.number(entry, "fov", 0.1, 179.0, where=name))
        return Pose(matrix[:3, 3].copy(), OPENGL_TO_OPENCV @ (left @ right).T, fov)

    def number(
        self, entry: dict[str, Any], key: str, low: float, high: float, default: float | None = None, where: str = ""
    ) -> float:
        field = f"{where}.{key}" if where else key
        value = entry.get(key)
        if value is None and default is not None:
            return default
        if value is None:
            raise self.wrong(field, "is missing")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong(field, f"is {shown(value)}, not a number")
        if not low <= value <= high:
            raise self.wrong(field, f"is {shown(value)}, outside {low:g} to {high:g}")
        return float(value)

    def wrong(self, field: str, what: str) -> InputError:
        return InputError(f"{self.file}: {field} {what}.")


def _matrix(pose: Pose) -> list[float]:
    """Camera to world in OpenGL's axes, 16 numbers row by row."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (OPENGL_TO_OPENCV @ pose.rotation).T, pose.position
    values: list[float] = matrix.ravel().tolist()
    return values
