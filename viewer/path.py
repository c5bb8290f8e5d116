"""A camera's path through the scene and the clip: key-frames, and what lies between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.splat.camera import Camera

Array = NDArray[np.float64]
_LIMIT = 2.0  # of a speed at a key-frame, in speeds of its slower side: nothing swings far beyond a key-frame


class Pose(NamedTuple):
    """Where a camera stands. position (3,), world units. rotation (3, 3): world to camera, OpenCV axes (x right, y
    down, z ahead). fov_y: vertical field of view, radians."""

    position: Array
    rotation: Array
    fov_y: float

    def camera(self, width: int, height: int) -> Camera:
        """The rasterizer's camera for a picture of this size."""
        f = 0.5 * height / math.tan(0.5 * self.fov_y)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        return Camera(K, world_to_camera(self.rotation.T, self.position), width, height)


class KeyFrame(NamedTuple):
    """second: when the path comes by. time: in the clip, 0 to 1."""

    second: float
    time: float
    pose: Pose


class CameraPath:
    """A path through its key-frames, at least one, in the order of their seconds; the first is at second 0.

    Positions and rotations move smoothly (their velocities do not jump, not even at key-frames, and they rest between
    two equal key-frames), fields of view too; times in the clip go linearly from key-frame to key-frame.
    """

    def __init__(self, keys: Iterable[KeyFrame]) -> None:
        from scipy.spatial.transform import Rotation  # not at the start of the viewer: it takes a fifth of a second

        ordered = sorted(keys, key=lambda key: key.second)
        start = ordered[0].second
        self.keys = tuple(key._replace(second=key.second - start) for key in ordered)
        self._moments = np.array([key.second for key in self.keys])
        if len(self.keys) > 1 and not (np.diff(self._moments) > 0).all():
            raise ValueError("two key-frames of a camera path are at the same second")
        gaps = np.diff(self._moments)[:, None]
        self._positions = np.stack([key.pose.position for key in self.keys])
        self._turns = Rotation.from_matrix(np.stack([key.pose.rotation for key in self.keys]))
        self._fovs = np.array([[key.pose.fov_y] for key in self.keys])
        self._velocities = _speeds(np.diff(self._positions, axis=0) / gaps, gaps)
        # Rotation vectors from one key-frame to the next, the shortest way, in camera axes: the same from both ends.
        turned = (self._turns[1:] * self._turns[:-1].inv()).as_rotvec() if len(self.keys) > 1 else np.zeros((0, 3))
        self._spins = _speeds(turned / gaps, gaps)
        slopes = np.diff(self._fovs, axis=0) / gaps
        self._zooms = _speeds(slopes, gaps)
        self._zooms[1:-1][slopes[1:] * slopes[:-1] <= 0] = 0.0  # never beyond the widest and the narrowest key-frame

    @property
    def seconds(self) -> float:
        """How long the path takes."""
        return self.keys[-1].second

    def at(self, second: float) -> tuple[Pose, float]:
        """The camera and the time in the clip at a second of the path; beyond its ends those of the end."""
        if len(self.keys) == 1:
            return self.keys[0].pose, self.keys[0].time
        second = min(max(second, 0.0), self.seconds)
        i = min(max(int(np.searchsorted(self._moments, second, "right")) - 1, 0), len(self.keys) - 2)
        gap = float(self._moments[i + 1] - self._moments[i])
        u = (second - float(self._moments[i])) / gap
        position = _hermite(self._positions, self._velocities, i, gap, u)
        fov = float(_hermite(self._fovs, self._zooms, i, gap, u)[0])
        time = (1 - u) * self.keys[i].time + u * self.keys[i + 1].time
        return Pose(position, self._rotation(i, gap, u), fov), time

    def _rotation(self, i: int, gap: float, u: float) -> Array:
        """De Casteljau's algorithm on rotations: a cubic curve with the angular velocities at its two ends."""
        from scipy.spatial.transform import Rotation

        first, last = self._turns[i], self._turns[i + 1]
        points = [
            first,
            Rotation.from_rotvec(self._spins[i] * gap / 3) * first,
            Rotation.from_rotvec(-self._spins[i + 1] * gap / 3) * last,
            last,
        ]
        while len(points) > 1:
            points = [Rotation.from_rotvec(u * (b * a.inv()).as_rotvec()) * a for a, b in itertools.pairwise(points)]
        matrix: Array = points[0].as_matrix()
        return matrix


def _speeds(chords: Array, gaps: Array) -> Array:
    """(K, D) velocities at K key-frames from the mean velocities (K - 1, D) between them and their seconds (K - 1, 1):
    in between the one of the parabola through three key-frames, cut to `_LIMIT` of the slower side."""
    if len(chords) == 0:
        return np.zeros((1, chords.shape[1]))
    before, after = chords[:-1], chords[1:]
    inner = (gaps[1:] * before + gaps[:-1] * after) / (gaps[1:] + gaps[:-1])
    length = np.linalg.norm(inner, axis=1)
    most = _LIMIT * np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
    inner = inner * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
    return np.concatenate([chords[:1], inner, chords[-1:]])


def _hermite(values: Array, speeds: Array, i: int, gap: float, u: float) -> Array:
    """The cubic from values[i] to values[i + 1] with these speeds at its ends, at u in [0, 1]."""
    a, b = values[i], values[i + 1]
    rest = 1 - u
    middle = 3 * u * rest * (rest * (a + speeds[i] * gap / 3) + u * (b - speeds[i + 1] * gap / 3))
    curve: Array = rest**3 * a + middle + u**3 * b
    return curve
