"""Normalize a capture: move and scale its cameras and points into the cube [-BOX, BOX]^3 that the presets expect.

The cube is that of D-NeRF's scenes, which keep their coordinates. Captures are never rotated.
"""

import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.focus import focus_of
from lapgs_wgpu.data.poses import place_of, world_to_camera
from lapgs_wgpu.splat.camera import Array, Camera

BOX = 1.3  # half side of the cube: D-NeRF's scenes lie in it
TAIL = 1.0  # per cent of the points that may lie outside at either end of each axis: outliers have no influence
ENCODED = 1.6  # half side of the encoder's box in every preset (field.bound), world units
MIN_SIZE = 0.5  # of BOX: half side from which on a scene is large enough to keep its coordinates
SEEN = 1.45  # half-width that D-NeRF's cameras see at the point that they look at, world units
QUANTILE = 75  # per cent of the cameras see no more than the cube shows: a few distant ones have no influence


class Normalization(NamedTuple):
    """How a capture was moved and scaled: world = (capture - center) * scale. center: (3,)."""

    center: Array
    scale: float

    def points(self, points: Array) -> Array:
        """Transform points (N, 3), or one (3,), from the capture's coordinates to the world's."""
        return (points - self.center) * self.scale

    def cloud(self, cloud: Cloud) -> Cloud:
        """Transform a cloud."""
        return Cloud(self.points(cloud.points.astype(np.float64)).astype(np.float32), cloud.colors)

    def pose(self, T_cam_world: Array) -> Array:
        """Transform a pose (4, 4)."""
        return world_to_camera(T_cam_world[:3, :3].T, self.points(place_of(T_cam_world)))

    def camera(self, camera: Camera) -> Camera:
        """Transform a camera."""
        near = self.scale * camera.near
        return Camera(camera.K, self.pose(camera.T_cam_world), camera.width, camera.height, near)

    def then(self, other: "Normalization") -> "Normalization":
        """Compose: this one first, then the other."""
        return Normalization(self.center + other.center / self.scale, self.scale * other.scale)

    def to_json(self) -> str:
        """Serialize to one line of JSON."""
        return json.dumps({"center": self.center.tolist(), "scale": self.scale})

    def __str__(self) -> str:
        half = BOX / self.scale
        at = ", ".join(f"{value if abs(value) > 1e-4 * half else 0:.4g}" for value in self.center)
        return f"the cube of half side {half:.4g} around ({at}) in the capture's files becomes [-{BOX:g}, {BOX:g}]^3"


class Cube(NamedTuple):
    """center: (3,). half: half side. Both in the capture's units."""

    center: Array
    half: float

    @property
    def fits(self) -> bool:
        """Whether the presets' encoder covers and resolves this cube as it is."""
        return bool(np.abs(self.center).max() + self.half <= ENCODED and self.half >= MIN_SIZE * BOX)


def cube_of_points(points: Array) -> Cube:
    """The cube that holds points (N, 3), except for TAIL per cent at either end of each axis."""
    low, high = np.percentile(points, [TAIL, 100 - TAIL], axis=0)
    return Cube((low + high) / 2, float(max((high - low).max() / 2, 1e-6)))


def cube_in_view(cameras: Sequence[Camera]) -> Cube | None:
    """The cube around the point that the cameras look at. Its size relates to their view as BOX to that of D-NeRF's.

    The size follows from the half-width (of the longer side) that the cameras see at that point; the QUANTILE decides.
    Returns None if half or more of the cameras look away from the point: the size is then unknown.
    """
    center = focus_of(cameras, origin=True)
    depths = np.array([(camera.T_cam_world @ [*center, 1.0])[2] for camera in cameras])
    tangents = np.array([max(c.width / c.K[0, 0], c.height / c.K[1, 1]) / 2 for c in cameras])
    ahead = depths > 0
    if 2 * ahead.sum() <= len(cameras):
        return None
    half = float(np.percentile((depths * tangents)[ahead], QUANTILE)) * BOX / SEEN
    return Cube(center, max(half, 1e-6))
