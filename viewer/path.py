"""A camera path through the scene and the clip: key-frames, and the smooth curve through them."""

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
_LIMIT = 2.0  # of a velocity at a key-frame, in mean velocities of its slower side


class Pose(NamedTuple):
    """Where a camera stands. position (3,), world units. rotation (3, 3): world to camera, OpenCV axes (x right, y
    down, z ahead). fov_y: vertical field of view, radians."""

    position: Array
    rotation: Array
    fov_y: float

    def camera(self, width: int, height: int) -> Camera:
        """Make the rasterizer's camera for a picture of this size."""
        f = 0.5 * height / math.tan(0.5 * self.fov_y)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        return Camera(K, world_to_camera(self.rotation.T, self.position), width, height)


class KeyFrame(NamedTuple):
    """A pose on a path. second: when the path comes by. time: in the clip, 0 to 1."""

    second: float
    time: float
    pose: Pose


class CameraPath:
    """A path through its key-frames, at least one, by ascending seconds; the first is at second 0.

    Positions, rotations (as quaternions, the shortest way) and fields of view follow cubic curves without jumps of
    velocity, and rest between two equal key-frames. Times in the clip are linear from key-frame to key-frame.
    """

    def __init__(self, keys: Iterable[KeyFrame]) -> None:
        # Not at the start of the viewer: it takes a fifth of a second.
        from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
        from scipy.spatial.transform import Rotation

        self.keys = tuple(keys)
        self._curve = None
        if len(self.keys) < 2:
            return
        seconds = np.array([key.second for key in self.keys])
        positions, turns, fovs = zip(*(key.pose for key in self.keys), strict=True)
        quats = Rotation.from_matrix(np.stack(turns)).as_quat()
        for before, after in itertools.pairwise(quats):
            after *= 1.0 if before @ after >= 0 else -1.0  # both signs are the same rotation
        parts = [np.stack(positions), quats]
        velocities = np.hstack([_velocities(values, seconds) for values in parts])
        self._curve = CubicHermiteSpline(seconds, np.hstack(parts), velocities)
        self._fov = PchipInterpolator(seconds, fovs)  # never beyond the widest and the narrowest key-frame

    @property
    def seconds(self) -> float:
        """Length of the path."""
        return self.keys[-1].second

    def at(self, second: float) -> tuple[Pose, float]:
        """Return camera and time in the clip at a second of the path; beyond its ends those of the end."""
        from scipy.spatial.transform import Rotation

        if self._curve is None:
            return self.keys[0].pose, self.keys[0].time
        second = min(max(second, 0.0), self.seconds)
        position, quat = np.split(self._curve(second), [3])
        pose = Pose(position, Rotation.from_quat(quat).as_matrix(), float(self._fov(second)))
        time = np.interp(second, [key.second for key in self.keys], [key.time for key in self.keys])
        return pose, float(time)


def _velocities(values: Array, seconds: Array) -> Array:
    """(K, D) velocities of values (K, D) at K >= 2 seconds: in between those of the parabola through three key-frames,
    cut to _LIMIT of the slower side, so that the path rests between equal key-frames and never swings far beyond one.
    """
    velocities: Array = np.gradient(values, seconds, axis=0)
    means = np.linalg.norm(np.diff(values, axis=0), axis=1) / np.diff(seconds)
    inner = velocities[1:-1]
    lengths = np.maximum(np.linalg.norm(inner, axis=1), 1e-300)
    inner *= np.minimum(1.0, _LIMIT * np.minimum(means[:-1], means[1:]) / lengths)[:, None]
    return velocities
