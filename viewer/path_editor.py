"""The camera path that is being made in the window: its key-frames, the chosen one, and its preview."""

from __future__ import annotations

from pathlib import Path

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose
from lapgs_wgpu.viewer.path_file import PathFile, read_path, write_path

_STEP = 2.0  # seconds from the last key-frame to a new one
_CLOSEST = 0.05  # seconds between two key-frames


class PathEditor:
    """The path under edit. keys: in the order of their seconds, the first at 0. chosen: number of a key-frame, or
    None. started: second (of any clock) at which the preview began, None where there is none."""

    def __init__(self) -> None:
        self.keys: list[KeyFrame] = []
        self.chosen: int | None = None
        self.started: float | None = None
        self._own: Path | None = None  # file that this path was loaded from or saved to

    def add(self, pose: Pose, time: float) -> None:
        """Add a key-frame, some seconds after the last one."""
        second = self.keys[-1].second + _STEP if self.keys else 0.0
        self.keys.append(KeyFrame(second, time, pose))
        self.chosen = len(self.keys) - 1

    def replace(self, pose: Pose, time: float) -> None:
        """Give the chosen key-frame another pose and time; its second stays."""
        assert self.chosen is not None
        self.keys[self.chosen] = KeyFrame(self.keys[self.chosen].second, time, pose)

    def delete(self) -> None:
        """Drop the chosen key-frame; the next one is chosen."""
        assert self.chosen is not None
        del self.keys[self.chosen]
        self.chosen = min(self.chosen, len(self.keys) - 1) if self.keys else None
        self.keys = list(CameraPath(self.keys).keys) if self.keys else []  # the first is at second 0

    def move(self, second: float) -> None:
        """Take the chosen key-frame to another second; where one is there already, beyond it."""
        assert self.chosen is not None
        key = self.keys.pop(self.chosen)
        step = _CLOSEST if second >= key.second else -_CLOSEST
        while any(abs(second - other.second) < 0.99 * _CLOSEST for other in self.keys):
            second += step
        self.chosen = sum(other.second < second for other in self.keys)
        self.keys = list(CameraPath([*self.keys, key._replace(second=second)]).keys)

    def play(self, now: float) -> None:
        """Start the preview, or end it."""
        self.started = None if self.started is not None or len(self.keys) < 2 else now

    def preview(self, now: float) -> tuple[Pose, float] | None:
        """Pose and time in the clip at this second of the preview; None where none is running. After its end the
        last key-frame once, so that the preview ends where the path does."""
        if self.started is None or not self.keys:
            return None
        path, second = CameraPath(self.keys), now - self.started
        if second >= path.seconds:
            self.started = None
        return path.at(second)

    def save(self, file: Path, size: tuple[int, int], fps: float) -> None:
        """Write the path. Raises InputError where it cannot be written, and where another path is there."""
        if file.exists() and file != self._own:
            raise InputError(f"{file}: holds another path; load it, or give that file another name.")
        write_path(file, PathFile(CameraPath(self.keys), size, fps))
        self._own = file

    def load(self, file: Path) -> None:
        """Read a path in place of this one. Raises InputError, and then keeps this one."""
        self.keys = list(read_path(file).path.keys)
        self.chosen = self.started = None
        self._own = file


def path_file_of(ply: Path) -> Path:
    """Name the file of the camera path that belongs to a .ply file."""
    return ply.with_name(f"{ply.stem}.camera_path.json")
