"""The camera path that is being made in the window."""

from __future__ import annotations

from lapgs_wgpu.viewer.path import CameraPath, KeyFrame, Pose

_STEP = 2.0  # seconds from a key-frame to the next


class PathEditor:
    """The path under edit. keys: its key-frames, _STEP apart. started: second (of any clock) at which the preview
    began, None where there is none."""

    def __init__(self) -> None:
        self.keys: list[KeyFrame] = []
        self.started: float | None = None

    def add(self, pose: Pose, time: float) -> None:
        """Add a key-frame after the last one."""
        self.keys.append(KeyFrame(_STEP * len(self.keys), time, pose))

    def undo(self) -> None:
        """Drop the last key-frame."""
        self.keys.pop()
        self.started = None

    def play(self, now: float) -> None:
        """Start the preview, or end it."""
        self.started = None if self.started is not None or len(self.keys) < 2 else now

    def preview(self, now: float) -> tuple[Pose, float] | None:
        """Pose and time in the clip at this second of the preview; None where none is running. After its end the
        last key-frame once, so that the preview ends where the path does."""
        if self.started is None:
            return None
        path, second = CameraPath(self.keys), now - self.started
        if second >= path.seconds:
            self.started = None
        return path.at(second)
