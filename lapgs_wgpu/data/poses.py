"""Check the poses of capture files and convert them to OpenCV's axes."""

from typing import Any

import numpy as np

from lapgs_wgpu.data.json_fields import Fields
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Array, rotation_matrix

# Largest deviation of R^T R from the identity: files store about seven digits; scale or shear exceeds this by far.
ROTATION_TOLERANCE = 1e-3
UNIT = 1e-2  # largest deviation of a quaternion's length from 1
# A rotation whose error moves no camera by more than this is kept as stored, in the capture's units: float32's.
EXACT = 1e-5
AXES_HINT = "poses may be in OpenCV's axes where the format has OpenGL's (y up, z backward), or the other way round"
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])  # y up, z backward -> y down, z forward


def check_rotation(R: Array, name: str) -> None:
    """Raise InputError unless R (3, 3) is a rotation. name: of the matrix, for errors."""
    error = np.abs(R.T @ R - np.eye(3)).max()
    if error > ROTATION_TOLERANCE:
        axes = " ".join(f"{x:.4g}" for x in np.linalg.norm(R, axis=0))
        raise InputError(
            f"{name} is not a rotation and a position: R^T R is {error:.3g} away from the identity (at most "
            f"{ROTATION_TOLERANCE:g} is allowed), its axes have lengths {axes}; remove scale and shear."
        )
    if np.linalg.det(R) < 0:
        raise InputError(f"{name} is left-handed (determinant -1): its axes are not the format's; export it again.")


def rotation_of(quaternion: Array, where: str) -> Array:
    """(3, 3) the rotation of a quaternion (4,), wxyz. Raises InputError where its length is far from 1."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > UNIT:
        raise InputError(f"{where}: its quaternion has length {length:g}, must be 1; export the poses again.")
    return rotation_matrix(quaternion / length)


def place_of(T_cam_world: Array) -> Array:
    """(3,) the place of a camera of pose (4, 4)."""
    return -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]


def world_to_camera(R_world_cam: Array, position: Array) -> Array:
    """Return the (4, 4) pose of a camera at `position` (3,) whose axes are the columns of R_world_cam (3, 3).

    An inexact rotation is replaced by the nearest one: the position follows from a pose by the rotation's inverse, and
    its error is that of the rotation times the distance from the origin.
    """
    reach = max(float(np.linalg.norm(position)), 1.0)
    if np.abs(R_world_cam.T @ R_world_cam - np.eye(3)).max() * reach > EXACT:
        U, _, V = np.linalg.svd(R_world_cam)
        R_world_cam = U @ V
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = R_world_cam.T, -R_world_cam.T @ position
    return T_cam_world


def opengl_pose(value: Any, where: str) -> Array:
    """The (4, 4) pose in OpenCV axes of the field transform_matrix of a transforms file: camera to world, OpenGL axes,
    its last row may be missing. where: file and frame, for errors. Raises InputError unless it is a rigid motion."""
    name = f"{where}: transform_matrix"
    if isinstance(value, list) and len(value) == 3:
        value = [*value, [0, 0, 0, 1]]
    T = Fields({"transform_matrix": value}, where).matrix("transform_matrix", 4, 4)
    if np.abs(T[3] - [0, 0, 0, 1]).max() > ROTATION_TOLERANCE:
        got = " ".join(f"{x:g}" for x in T[3])
        raise InputError(f"{name} must end with the row 0 0 0 1, got {got}; the position stands at the right.")
    check_rotation(T[:3, :3], name)
    return world_to_camera(T[:3, :3] @ OPENGL_TO_OPENCV, T[:3, 3])
