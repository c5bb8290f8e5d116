"""The pinhole camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV axes: x right, y down, z forward.

    Attributes:
        K: (3, 3) float64 intrinsics in pixels; the center of pixel (column, row) is (column + 0.5, row + 0.5).
        T_cam_world: (4, 4) float64 rigid transform from world to camera coordinates.
        width: of the image, pixels.
        height: of the image, pixels.
        near: depth up to which nothing is drawn, world units; the shaders' NEAR where that is larger.

    Raises:
        ValueError: a shape or a size is wrong, or a value is not finite.
    """

    K: NDArray[np.float64]
    T_cam_world: NDArray[np.float64]
    width: int
    height: int
    near: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.asarray(self.K, dtype=np.float64))
        object.__setattr__(self, "T_cam_world", np.asarray(self.T_cam_world, dtype=np.float64))
        if self.K.shape != (3, 3) or self.T_cam_world.shape != (4, 4):
            raise ValueError(f"Camera needs K (3, 3), T_cam_world (4, 4), got {self.K.shape}, {self.T_cam_world.shape}")
        if not (np.isfinite(self.K).all() and np.isfinite(self.T_cam_world).all()):
            raise ValueError("Camera: K and T_cam_world must be finite")
        if not 0 <= self.near < math.inf:
            raise ValueError(f"Camera: near must be a finite depth of at least 0, got {self.near}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Camera: width and height must be at least 1, got {self.width}x{self.height}")

    @property
    def position(self) -> NDArray[np.float64]:
        """The camera center (3,) in world coordinates."""
        R, t = self.T_cam_world[:3, :3], self.T_cam_world[:3, 3]
        return -R.T @ t

    def project(self, points: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return pixel coordinates (N, 2) and depths (N,) of points (N, 3), world units; infinite or NaN at depth 0."""
        local = points @ self.T_cam_world[:3, :3].T + self.T_cam_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return (local @ self.K.T)[:, :2] / local[:, 2:], local[:, 2]

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same camera for an image of another size: width and height in pixels."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Camera(scale @ self.K, self.T_cam_world, width, height, self.near)

    @staticmethod
    def looking_at(
        position: NDArray[np.float64] | list[float],
        target: NDArray[np.float64] | list[float],
        *,
        up: NDArray[np.float64] | list[float],
        fov_x: float,
        width: int,
        height: int,
    ) -> "Camera":
        """Return a camera with square pixels that looks at a point.

        Args:
            position: (3,) of the camera, world units.
            target: (3,) point at the center of the image, world units.
            up: (3,) world direction that points up in the image.
            fov_x: horizontal field of view, radians.
            width: of the image, pixels.
            height: of the image, pixels.

        Returns:
            The camera.

        Raises:
            ValueError: target at the position, up along the view, or a field of view that is none.
        """
        eye = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target, dtype=np.float64) - eye
        if not np.linalg.norm(forward) > 0:
            raise ValueError(f"Camera.looking_at: position and target must differ, got {eye.tolist()} for both")
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, dtype=np.float64))
        if not np.linalg.norm(right) > 0:
            raise ValueError(f"Camera.looking_at: up must not lie along the view, got {np.asarray(up).tolist()}")
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ eye
        return Camera(intrinsics_of_fov(fov_x, width, height), T, width, height)


def rotation_matrix(quaternion: NDArray[np.floating] | Sequence[float]) -> NDArray[Any]:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,) wxyz; (3, 3, N) of (4, N)."""
    return np.array(rotation_rows(*quaternion))


def rotation_rows(w: Any, x: Any, y: Any, z: Any) -> list[list[Any]]:
    """Return the rows of the rotation matrix of a unit quaternion, whose parts are numbers, arrays or tensors."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def intrinsics_of_fov(fov_x: float, width: int, height: int) -> NDArray[np.float64]:
    """Return K (3, 3) for a horizontal field of view in radians, with square pixels and a centered principal point."""
    if not 0 < fov_x < math.pi:
        raise ValueError(f"the field of view must be between 0 and pi radians, got {fov_x:g}")
    focal = 0.5 * width / math.tan(0.5 * fov_x)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
