"""The camera that the mouse and the keys move, how it becomes the rasterizer's, and its way around the focus."""

import math
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.splat.camera import Array, Camera, rotation_matrix

_STEEPEST = math.radians(89)  # of the line of sight, up or down: beyond it the picture would turn over


class ViewCamera:
    """A camera that turns about a focus. World frame and units are the scene's; camera axes are OpenCV's.

    position (3,), focus (3,), up (3,) of unit length; fov_y: vertical field of view in radians.
    near: depth up to which nothing is drawn, world units.
    """

    def __init__(self, camera: Camera, focus: ArrayLike, up: ArrayLike) -> None:
        """Start where a camera stands; the focus is moved onto its line of sight."""
        self.position: Array = camera.position
        self.focus: Array = np.asarray(focus, np.float64)
        self.up: Array = np.asarray(up, np.float64) / np.linalg.norm(up)
        self.near = camera.near
        self.stand_at(camera)
        self._start = (self.position, self.focus, self.rotation, self.fov_y)

    @property
    def distance(self) -> float:
        """Distance from the position to the focus, world units."""
        return float(np.linalg.norm(self.focus - self.position))

    def stand_at(self, camera: Camera) -> None:
        """Stand where a camera stands, with its vertical field of view; the picture fills the window."""
        distance = max(float((self.focus - camera.position) @ camera.T_cam_world[2, :3]), 1e-3 * self.distance, 1e-6)
        self.rotation = camera.T_cam_world[:3, :3].copy()
        self.position = camera.position
        self.focus = self.position + distance * self.rotation[2]
        self.fov_y = 2 * math.atan(0.5 * camera.height / camera.K[1, 1])

    def reset(self) -> None:
        """Go back to where the camera started."""
        self.position, self.focus, self.rotation, self.fov_y = self._start

    def orbit(self, right: float, down: float) -> None:
        """Turn about the focus, as if the scene were dragged; radians. To the right it turns about `up`, so that the
        horizon stays as level, or as rolled, as it was."""
        distance = self.distance
        turned = self.rotation @ _about(self.up, right)
        across = np.cross(turned[2], self.up)
        length = np.linalg.norm(across)
        across = across / length if length > 1e-6 else turned[0]
        pitch = math.asin(float(np.clip(turned[2] @ self.up, -1, 1)))
        new = float(np.clip(pitch - down, -_STEEPEST, _STEEPEST))
        self.rotation = turned @ _about(across, pitch - new)
        self.position = self.focus - distance * self.rotation[2]

    def pan(self, right: float, down: float) -> None:
        """Drag the scene, by these parts of the picture's height at the focus."""
        reach = 2 * self.distance * math.tan(0.5 * self.fov_y)
        by = -reach * (right * self.rotation[0] + down * self.rotation[1])
        self.position, self.focus = self.position + by, self.focus + by

    def zoom(self, factor: float) -> None:
        """Multiply the distance to the focus."""
        self.position = self.focus + factor * (self.position - self.focus)

    def focus_on(self, point: ArrayLike) -> None:
        """Turn about another point from now on, which moves to the middle of the picture, the horizon level."""
        point = np.asarray(point, np.float64)
        with suppress(ValueError):  # where the camera stands, or straight above or below it
            seen = Camera.looking_at(self.position, point, up=self.up, fov_x=1.0, width=1, height=1)
            self.focus, self.rotation = point, seen.T_cam_world[:3, :3]

    def camera(self, width: int, height: int) -> Camera:
        """Make the rasterizer's camera for a picture of this size."""
        f = 0.5 * height / math.tan(0.5 * self.fov_y)
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        return Camera(K, world_to_camera(self.rotation.T, self.position), width, height, self.near)


def _about(axis: Array, angle: float) -> Array:
    """(3, 3) rotation by an angle about a unit axis, right-handed."""
    return rotation_matrix([math.cos(0.5 * angle), *(math.sin(0.5 * angle) * axis)])


def orbit_views(
    start: ViewCamera,
    size: tuple[int, int],
    frames: int,
    time: float | None,
    arc: tuple[float, float] | None = None,
) -> Iterator[tuple[Camera, float]]:
    """Go around the focus once: cameras, and times in the clip. time: fixed, in [0, 1]; None plays the clip once.
    arc: swing to these degrees clockwise and counterclockwise (`InitialView.arc`) instead of going all around."""
    turned = 0.0  # radians clockwise
    for number, passed in enumerate(np.linspace(0, 1, frames).tolist()):
        angle = 2 * math.pi * (number / frames)
        if arc is not None:
            wave = math.sin(angle)
            angle = math.radians(wave * (arc[0] if wave > 0 else arc[1]))
        if number:
            start.orbit(angle - turned, 0.0)
        turned = angle
        yield start.camera(*size), passed if time is None else time
