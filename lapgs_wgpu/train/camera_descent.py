"""Steps of cameras along the gradient of an image, in coordinates of which each moves the image alike.

A small turn of a camera and a small shift of it look nearly the same; only parallax tells them apart. The matrix J^T J
of the image motion, over points of the scene, says how much each change is seen, and its inverse root whitens the
gradient (CamP, Park et al. 2023). One second moment serves all cameras and directions: where nothing pulls, nothing
moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.splat.camera import Camera

MEAN_DECAY = 0.5  # of a camera's momentum: it is seen a few dozen times
SQUARE_DECAY = 0.98  # of the second moment, which all cameras share
MOST_POINTS = 2000  # of the scene that the image motion is measured at
NEAREST = 0.05  # depth relative to the median of the points, below which a point does not count
Array = NDArray[np.float64]


class ScenePoints(NamedTuple):
    """Points of a scene: positions (N, 3), world units, and weights (N,)."""

    positions: Array
    weights: Array


def scene_points(means: Tensor, opacities: Tensor) -> ScenePoints:
    """At most MOST_POINTS of a scene's Gaussians: means (N, 3), opacities (N,)."""
    chosen = slice(None, None, -(-len(means) // MOST_POINTS))
    points, weights = (values.detach()[chosen].double().numpy(force=True) for values in (means, opacities))
    return ScenePoints(points, weights)


def image_motion(camera: Camera, points: ScenePoints, unit: float) -> Array:
    """(6, 6) weighted mean of J^T J over the points in the image, radians squared.

    J is the derivative of a point's place in the image, in units of the focal length, by a rotation of the camera about
    its center (along the world's axes, radians) and by a shift of it, in units of `unit` world units. Zeros where no
    point is in the image.
    """
    R = camera.T_cam_world[:3, :3]
    arm = points.positions - camera.position
    x, y, z = (arm @ R.T).T
    ahead = z > NEAREST * np.median(z[z > 0]) if (z > 0).any() else z > 0
    x, y, z, arm, weights = x[ahead], y[ahead], z[ahead], arm[ahead], points.weights[ahead]
    u, v = x / z, y / z
    focal, center = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    across, down = focal[0] * u + center[0], focal[1] * v + center[1]
    inside = (across >= 0) & (across < camera.width) & (down >= 0) & (down < camera.height)
    u, v, z, arm, weights = u[inside], v[inside], z[inside], arm[inside], weights[inside]
    # The rows of the projection's derivative by the point, along the world's axes.
    rows = np.stack([R[0] - u[:, None] * R[2], R[1] - v[:, None] * R[2]], axis=1) / z[:, None, None]
    J = np.concatenate([np.cross(rows, arm[:, None]), -unit * rows], axis=2)
    total = weights.sum()
    return np.einsum("n,nij,nik->jk", weights, J, J) / total if total > 0 else np.zeros((6, 6))


def whitening(motion: Array, damping: float) -> Array:
    """(6, 6) symmetric inverse root of `image_motion`, to whose eigenvalues `damping` times their mean is added."""
    mean = np.trace(motion) / 6
    if mean <= 0:
        return np.zeros((6, 6))
    values, vectors = np.linalg.eigh(motion)
    return (vectors / np.sqrt(np.maximum(values, 0) + damping * mean)) @ vectors.T


class CameraDescent:
    """The momenta of cameras, and the second moment that they share."""

    def __init__(self, count: int) -> None:
        self._mean = torch.zeros(count, 6, dtype=torch.float64)
        self._steps = torch.zeros(count)
        self._square, self._moves = torch.zeros(1, dtype=torch.float64), torch.zeros(1)

    def change(self, number: int, gradient: Array, whiten: Array, rate: float) -> Array:
        """(6,) change of a camera: rotation, radians, and shift, in the units of `image_motion`.

        gradient: (6,) of the loss. rate: of the image's motion, radians.
        """
        white = whiten @ gradient
        self._moves += 1
        self._steps[number] += 1
        self._square.mul_(SQUARE_DECAY).add_((1 - SQUARE_DECAY) * float(white @ white))
        mean = self._mean[number].mul_(MEAN_DECAY).add_((1 - MEAN_DECAY) * torch.from_numpy(white)).numpy()
        size = np.sqrt(float(self._square) / (1 - SQUARE_DECAY ** float(self._moves)))
        unbiased = mean / (1 - MEAN_DECAY ** float(self._steps[number]))
        return -rate / size * (whiten @ unbiased) if size > 0 else np.zeros(6)

    def state(self) -> Mapping[str, Tensor]:
        """Everything that the next step depends on, besides the gradient."""
        return {"mean": self._mean, "square": self._square, "steps": self._steps, "moves": self._moves}
