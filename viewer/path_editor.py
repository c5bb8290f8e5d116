"""The camera path that is being made in the window: its key-frames, the chosen one, and its preview."""

from __future__ import annotations

from pathlib import Path

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import move
from lapgs_wgpu.viewer.camera import ViewCamera
from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose
from lapgs_wgpu.viewer.path_file import PathFile, read_path, write_path

_STEP = 2.0  # seconds from the last key-frame to a new one
_CLOSEST = 0.05  # seconds between two key-frames


class PathEditor:
    """keys: in the order of their seconds, the first at 0. chosen: number of a key-frame, or None. started: moment
    (seconds of any clock) at which the preview began, None where there is none."""

    def __init__(self) -> None:
        self.keys: list[KeyFrame] = []
        self.chosen: int | None = None
        self.started: float | None = None
        self._known: Path | None = None  # file that this path was loaded from or saved to

    @property
    def path(self) -> CameraPath | None:
        """The path through the key-frames; None where there are none."""
        return CameraPath(self.keys) if self.keys else None

    def add(self, camera: ViewCamera, time: float) -> None:
        """A new key-frame here and now, some seconds after the last one."""
        second = self.keys[-1].second + _STEP if self.keys else 0.0
        self.keys.append(KeyFrame(second, time, camera.pose))
        self.chosen = len(self.keys) - 1

    def replace(self, camera: ViewCamera, time: float) -> None:
        """The chosen key-frame moves here and now; its second stays."""
        assert self.chosen is not None
        self.keys[self.chosen] = KeyFrame(self.keys[self.chosen].second, time, camera.pose)

    def delete(self) -> None:
        """Drop the chosen key-frame; the next one is chosen."""
        assert self.chosen is not None
        del self.keys[self.chosen]
        self._arrange(min(self.chosen, len(self.keys) - 1))

    def move(self, second: float) -> None:
        """The chosen key-frame goes to another second; where one is nearly there already, a little beyond it."""
        assert self.chosen is not None
        way = 1.0 if second >= self.keys[self.chosen].second else -1.0
        others = [key.second for i, key in enumerate(self.keys) if i != self.chosen]
        while any(abs(second - other) < 0.99 * _CLOSEST for other in others):
            second += way * _CLOSEST
        moved = self.keys[self.chosen]._replace(second=second)
        self.keys[self.chosen] = moved
        self.keys.sort(key=lambda key: key.second)
        self._arrange(next(i for i, key in enumerate(self.keys) if key is moved))

    def _arrange(self, chosen: int) -> None:
        self.chosen = chosen if self.keys else None
        self.keys = list(CameraPath(self.keys).keys) if self.keys else []

    def play(self, now: float) -> None:
        """Start the preview, or end it."""
        self.started = None if self.started is not None or len(self.keys) < 2 else now

    def preview(self, now: float) -> tuple[Pose, float] | None:
        """Camera and time in the clip at this moment of the preview; None where none is running. After its end the
        last key-frame once, so that the preview ends where the path does."""
        path = self.path
        if self.started is None or path is None:
            return None
        second = now - self.started
        if second >= path.seconds:
            self.started = None
        return path.at(second)

    def save(self, file: Path, size: tuple[int, int], fps: float) -> Path | None:
        """Write the path. A file that was neither loaded nor saved here is kept under the name that is returned.
        Raises InputError where there is no path, or where it cannot be written."""
        path = self.path
        if path is None:
            raise InputError("there is no key-frame to save yet; K adds one.")
        kept = None
        if file.exists() and file != self._known:
            kept = file.with_name(f"{file.stem}.before.json")
            try:
                move(file, kept)
            except OSError as error:
                raise InputError(f"{file}: another path is there and cannot be kept ({error.strerror}).") from error
        write_path(file, PathFile(path, size, fps))
        self._known = file
        return kept

    def load(self, file: Path) -> None:
        """Read a path in place of this one. Raises InputError, and then keeps this one."""
        self.keys = list(read_path(file).path.keys)
        self.chosen = self.started = None
        self._known = file


def path_file_of(ply: Path) -> Path:
    """The file of the camera path that belongs to a .ply file."""
    return ply.with_name(f"{ply.stem}.camera_path.json")
