"""Poses of cameras as files give them: checked to be rigid, and brought to OpenCV's axes and to a known place."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.fields import kind, number
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

Array = NDArray[np.float64]

# Largest deviation of R^T R from the identity: files hold about seven digits, a scaled or sheared camera is far beyond.
ROTATION_TOLERANCE = 1e-3
SHORTEST_FOCAL, LONGEST_FOCAL = 0.05, 1000.0  # of a picture's longer side: 169 and 0.06 degrees of view
LARGEST_ENTRY = 1e9  # of a pose: a camera further away is a mistake, and its matrix products lose all digits
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])  # y up, z backward -> y down, z forward
BOX = 1.3  # half side of the cube around the origin that a capture is brought to: that of D-NeRF's scenes
TAIL = 1.0  # per cent of the points at either end of each axis that may lie outside: stray ones decide nothing


class Placement(NamedTuple):
    """How a capture was moved: world = (capture - center) * scale, for cameras and points alike. center: (3,)."""

    center: Array
    scale: float

    def points(self, points: Array) -> Array:
        """Points (N, 3), or one (3,), from the capture's coordinates to the world's."""
        return (points - self.center) * self.scale

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps({"center": self.center.tolist(), "scale": self.scale})

    def __str__(self) -> str:
        half = BOX / self.scale
        at = ", ".join(f"{value if abs(value) > 1e-4 * half else 0:.4g}" for value in self.center)
        return f"the cube of half side {half:.4g} around ({at}) in the capture's files becomes [-{BOX:g}, {BOX:g}]^3"

    def then(self, other: Placement) -> Placement:
        """This one first, the other afterwards."""
        return Placement(self.center + other.center / self.scale, self.scale * other.scale)

    def camera(self, camera: Camera) -> Camera:
        """The same view of the moved capture."""
        R = camera.T_cam_world[:3, :3]
        return Camera(camera.K, world_to_camera(R.T, self.points(camera.position)), camera.width, camera.height)


def fitting(points: Array) -> Placement:
    """What brings points (N, 3), but for TAIL per cent at either end of each axis, into [-BOX, BOX]^3.

    The fields, and the steps in which Gaussians move, have sizes that fit that cube.
    """
    low, high = np.percentile(points, [TAIL, 100 - TAIL], axis=0)
    half = float(max((high - low).max() / 2, 1e-6))
    return Placement((low + high) / 2, BOX / half)


def check_rotation(R: Array, name: str) -> None:
    """InputError, in which `name` calls the matrix, unless R (3, 3) turns and does nothing else."""
    lengths = np.linalg.norm(R, axis=0)
    error = np.abs(R.T @ R - np.eye(3)).max()
    if lengths.min() < 1e-6:
        raise InputError(f"{name} has zero scale (an axis of length {lengths.min():g}); its axes must have length 1.")
    if error > ROTATION_TOLERANCE:
        axes = " ".join(f"{x:.4g}" for x in lengths)
        raise InputError(
            f"{name} is not a rotation and a position: R^T R is {error:.3g} away from the identity (at most "
            f"{ROTATION_TOLERANCE:g} is allowed), its axes have lengths {axes}; remove scale and shear."
        )
    if np.linalg.det(R) < 0:
        raise InputError(f"{name} is left-handed (determinant -1, must be 1); flip one of its axes.")


def check_focal(camera: Camera, where: str) -> None:
    """InputError, which begins with `where`, unless both focal lengths are those of a camera that could be built."""
    longer = max(camera.width, camera.height)
    for focal in (camera.K[0, 0], camera.K[1, 1]):
        if not SHORTEST_FOCAL * longer <= focal <= LONGEST_FOCAL * longer:
            raise InputError(
                f"{where}: a focal length of {focal:.4g} pixels does not go with pictures of {camera.width}x"
                f"{camera.height}; it must be {SHORTEST_FOCAL:g} to {LONGEST_FOCAL:g} times the longer side."
            )


def world_to_camera(R_world_cam: Array, position: Array) -> Array:
    """(4, 4) T_cam_world of a camera at `position` (3,) whose axes are the columns of R_world_cam (3, 3)."""
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = R_world_cam.T, -R_world_cam.T @ position
    return T_cam_world


def opengl_pose(value: Any, where: str) -> Array:
    """(4, 4) T_cam_world in OpenCV axes from a camera-to-world matrix in OpenGL axes, checked to be a rigid motion.

    value: the field transform_matrix of a transforms file. where: what errors call its frame."""
    name = f"{where}: transform_matrix"
    rows = value if isinstance(value, list) else []
    if len(rows) != 4 or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(f"{name} must be 4 rows of 4 numbers, got {kind(value)}.")
    T = np.array([[number(entry, "transform_matrix", where) for entry in row] for row in rows])
    bad = np.argwhere(~(np.abs(T) <= LARGEST_ENTRY))  # so written, NaN is bad too
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{name} holds {T[row, column]:g} in row {row}, column {column}; "
            f"its entries must be finite and at most {LARGEST_ENTRY:g}."
        )
    if np.abs(T[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        raise InputError(f"{name} must end with the row 0 0 0 1, got {' '.join(f'{x:g}' for x in T[3])}.")
    R, position = T[:3, :3], T[:3, 3]
    check_rotation(R, name)
    return world_to_camera(R @ OPENGL_TO_OPENCV, position)
