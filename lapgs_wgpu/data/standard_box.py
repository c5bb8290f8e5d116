"""The cube that a capture in D-NeRF's layout fills, and how it is normalized where that is not the presets' cube.

D-NeRF's own scenes lie in [-1.3, 1.3]^3 and keep their coordinates. Other scenes in this layout have any
size and place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.data.cloud import Cloud, in_view
from lapgs_wgpu.data.poses import BOX, Array, Placement, fitting
from lapgs_wgpu.splat.camera import Camera

ENCODED = 1.6  # half side of the encoder's box in every preset (field.bound), world units
SMALLEST = 0.5  # of BOX: half side from which on a scene is large enough to keep its coordinates
SEEN = 1.45  # half-width that D-NeRF's cameras see at the point that they look at, world units
QUANTILE = 75  # per cent of the cameras see no more than the box shows: a few distant ones do not decide
PARALLEL = 1e-2  # mean squared sine between lines of sight below which they do not determine a point
ITERATIONS = 20  # of the reweighted least squares
DENSITY, LEAST_CELLS = 8, 4  # points in a cell, on average; cells along an axis
FILLED = 0.95  # share of cells with points from which on a cloud is random: a scene's surfaces leave most empty


class Cube(NamedTuple):
    """center: (3,). half: half side. Both in the capture's units."""

    center: Array
    half: float

    @property
    def placement(self) -> Placement | None:
        """What brings the cube to [-BOX, BOX]^3; None where the encoder covers and resolves it as it is."""
        if np.abs(self.center).max() + self.half <= ENCODED and self.half >= SMALLEST * BOX:
            return None
        return Placement(self.center, BOX / self.half)


def cube_of_cloud(cloud: Cloud) -> Cube:
    """The cube that holds a cloud of the scene's surfaces (`poses.fitting`)."""
    fit = fitting(cloud.points.astype(np.float64))
    return Cube(fit.center, BOX / fit.scale)


def cube_in_view(cameras: Sequence[Camera]) -> Cube | None:
    """The cube around the point that the cameras look at, as large as BOX is in what D-NeRF's cameras see.

    Its size follows from the half-width (of the longer side) that the cameras see at that point; the QUANTILE decides.
    Returns None where most cameras look away from that point, so that they do not tell what they see.
    """
    center = _looked_at(cameras)
    depths = np.array([(camera.T_cam_world @ [*center, 1.0])[2] for camera in cameras])
    tangents = np.array([max(c.width / c.K[0, 0], c.height / c.K[1, 1]) / 2 for c in cameras])
    ahead = depths > 0
    if 2 * ahead.sum() <= len(cameras):
        return None
    half = float(np.percentile((depths * tangents)[ahead], QUANTILE)) * BOX / SEEN
    return Cube(center, max(half, 1e-6))


def _looked_at(cameras: Sequence[Camera]) -> Array:
    """(3,) the point of the least sum of distances from the lines of sight, so that stray cameras do not move it.

    Parallel lines determine none. Then it is the origin, where D-NeRF's layout has its scene, if half of the cameras
    see it; else it is one radius of the cameras in front of them, or 1 where they coincide.
    """
    centres = np.stack([camera.position for camera in cameras])
    ahead = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    guess = centres.mean(axis=0) + (radius or 1.0) * ahead.mean(axis=0)
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < PARALLEL:
        origin = np.zeros((1, 3))
        return origin[0] if np.mean([in_view(origin, camera)[1][0] for camera in cameras]) >= 0.5 else guess
    point, weights = guess, np.full(len(cameras), 1 / len(cameras))
    for _ in range(ITERATIONS):
        matrix = np.einsum("n,nij->ij", weights, across)
        # A little of the guess: reweighting may leave parallel lines alone.
        faint = 1e-6 * np.trace(matrix) * np.eye(3)
        point = np.linalg.solve(matrix + faint, np.einsum("n,nij,nj->i", weights, across, centres) + faint @ guess)
        misses = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        floor = 1e-3 * float(np.median(np.linalg.norm(point - centres, axis=1))) + 1e-12
        weights = 1 / np.maximum(misses / floor, 1.0)
    return point


def is_random(cloud: Cloud) -> bool:
    """Whether a cloud fills its bounding box evenly, as the random clouds that other trainers write into the folder."""
    points = cloud.points.astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    cells = min(int((len(points) / DENSITY) ** (1 / 3)), 32)
    if cells < LEAST_CELLS or not (high > low).all():
        return False
    at = np.minimum(((points - low) / (high - low) * cells).astype(int), cells - 1)
    return len(np.unique(at @ [cells * cells, cells, 1])) >= FILLED * cells**3
