"""Cameras corrected while training: of each training camera its rotation and its place.

Poses of own footage come from structure from motion and are a little off, which a training answers with blur. The
gradient is that of the rasterizer's backward pass (`camera_bwd`); the steps move each image alike (`CameraDescent`).
What all cameras could do together without any image changing (shift, turn and scale of the whole scene) is taken out,
and corrections are pulled back to zero.

A small turn of a camera and a small shift of it look nearly the same; only parallax tells them apart. The matrix J^T J
of the image motion, over points of the scene, says how much each change is seen, and its inverse root whitens the
gradient (CamP, Park et al. 2023).

A view of a film that is held out is corrected as the images before and after it are: none of its own pixels is asked.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Array, Camera
from lapgs_wgpu.train.config import CamerasConfig
from lapgs_wgpu.train.optimizer import rate_at

MEAN_DECAY = 0.5  # of a camera's momentum: it is seen a few dozen times
SQUARE_DECAY = 0.98  # of the second moment, which all cameras share
MOST_POINTS = 2000  # of the scene that the image motion is measured at
NEAREST = 0.05  # depth relative to the median of the points, below which a point does not count


class ScenePoints(NamedTuple):
    """Points of a scene: positions (N, 3), world units, and weights (N,)."""

    positions: Array
    weights: Array


def scene_points(means: Tensor, opacities: Tensor) -> ScenePoints:
    """At most MOST_POINTS of a scene's Gaussians: means (N, 3), opacities (N,)."""
    spacing = -(-len(means) // MOST_POINTS)
    return ScenePoints(*(values.detach()[::spacing].double().numpy(force=True) for values in (means, opacities)))


def image_motion(camera: Camera, points: ScenePoints, unit: float) -> Array:
    """(6, 6) weighted mean of J^T J over the points in the image, radians squared.

    J is the derivative of a point's place in the image, in units of the focal length, by a rotation of the camera about
    its center (along the world's axes, radians) and by a shift of it, in units of `unit` world units. Zeros where no
    point is in the image.
    """
    R, arm = camera.T_cam_world[:3, :3], points.positions - camera.position
    x, y, z = (arm @ R.T).T
    pixels, _ = camera.project(points.positions)
    seen = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1) & (z > 0)
    if seen.any():
        seen &= z > NEAREST * np.median(z[z > 0])
    z, arm, weights = z[seen], arm[seen], points.weights[seen]
    u, v = x[seen] / z, y[seen] / z
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
    """The momenta of cameras, and the mean squared gradient that all share: where nothing pulls, nothing moves."""

    def __init__(self, count: int) -> None:
        self._mean = torch.zeros(count, 6, dtype=torch.float64)
        self._steps = torch.zeros(count)
        self._square, self._moves = torch.zeros(1, dtype=torch.float64), torch.zeros(1)

    def change(self, number: int, gradient: Array, whiten: Array, rate: float) -> Array:
        """(6,) change of a camera: rotation, radians, and shift, in the units of `image_motion`. gradient: (6,) of the
        loss. rate: of the image's motion, radians."""
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


class Pace(NamedTuple):
    """How far a step moves a camera: rate, radians of the image's motion; damping, of `whitening`; kept, the share of
    the correction that is not pulled back."""

    rate: float
    damping: float
    kept: float


# (6,) rotation vector and shift, world units, of cameras (the same objects).
Corrections = Mapping[Camera, Array]


class CameraRefinement:
    """The corrections of all training cameras, and how they learn.

    cameras: distinct ones. extent: distance that counts as 1 in shifts, world units. points: the scene as it is, asked
    at each step: what moves how far in the image when a camera moves. before: corrections of some to go on from, at the
    final learning rate and from the first step on.

    numbers: of the cameras (the same objects). common: (6 C, r) orthonormal: changes that no image shows.
    """

    name = "cameras"
    summary = (  # of `report`
        "the training cameras were corrected by {rotation_degrees[median]:.2f} degrees and {shift_percent[median]:.2f} "
        "% of their extent (medians; at most {rotation_degrees[largest]:.2f} and {shift_percent[largest]:.2f} %)."
    )

    def __init__(
        self,
        cameras: Sequence[Camera],
        extent: float,
        config: CamerasConfig,
        points: Callable[[], ScenePoints],
        before: Corrections | None = None,
    ) -> None:
        self._cameras, self.extent, self._config, self._points = list(cameras), extent, config, points
        self.numbers = {camera: number for number, camera in enumerate(self._cameras)}
        count = len(self._cameras)
        # Zeros that get the gradient by a further change of a camera: rotation, and shift in units of the extent.
        self.values = nn.Parameter(torch.zeros(count, 6))
        self._learnt = torch.zeros(count, 6, dtype=torch.float64)  # rotation vectors, shifts
        self._descent = CameraDescent(count)
        self.common = torch.from_numpy(_common_motions(self._cameras, extent))
        self._settled = torch.zeros(1)
        if before is not None:
            self._settled += 1
            for camera, correction in before.items():
                self._learnt[self.numbers[camera]] = torch.from_numpy(correction * _units(1 / extent))

    def correction(self, camera: Camera) -> Array:
        """(6,) what one of the cameras is corrected by: rotation vector and shift, world units."""
        return self._learnt[self.numbers[camera]].numpy() * _units(self.extent)

    def refined(self, camera: Camera) -> Camera:
        """The corrected form of one of the cameras."""
        return changed_camera(camera, self.correction(camera))

    def pace(self, step: int) -> Pace | None:
        """How far cameras move in a step, counted from 1; None in steps that move none."""
        config = self._config
        if not (self._settled or step >= config.start):
            return None
        rate = config.rate.end if self._settled else rate_at(config.rate, step)
        # A scene that is still blurred says nothing of what only parallax tells: the damping falls with the rate.
        return Pace(rate, (rate / config.rate.start) ** 2 if config.rate.start else 1.0, 1 - rate * config.pull)

    @torch.no_grad()
    def step(self, step: int) -> None:
        """Move the cameras that have a gradient, at the rate of this step (counted from 1), and forget it."""
        gradient, pace = self.values.grad, self.pace(step)
        self.values.grad = None
        if gradient is None or pace is None:
            return
        rate, damping, kept = pace
        rows, points = gradient.any(dim=1).nonzero()[:, 0].tolist(), self._points()
        for row in rows:
            whiten = whitening(image_motion(self.refined(self._cameras[row]), points, self.extent), damping)
            change = self._descent.change(row, gradient[row].double().numpy(), whiten, rate)
            turned = Rotation.from_rotvec(change[:3]) * Rotation.from_rotvec(self._learnt[row, :3].numpy())
            self._learnt[row, :3] = torch.from_numpy(turned.as_rotvec())
            self._learnt[row, 3:] += torch.from_numpy(change[3:])
        self._learnt[rows] *= kept
        flat = self._learnt.view(-1)
        flat -= self.common @ (self.common.T @ flat)

    def report(self) -> dict[str, dict[str, float]]:
        """How far the cameras went: degrees, and per cent of their extent."""
        turns = np.degrees(self._learnt[:, :3].norm(dim=1).numpy())
        shifts = 100 * self._learnt[:, 3:].norm(dim=1).numpy()
        return {
            name: {"median": float(np.median(values)), "largest": float(values.max())}
            for name, values in (("rotation_degrees", turns), ("shift_percent", shifts))
        }

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, besides the gradient."""
        return {"learnt": self._learnt, "settled": self._settled, **self._descent.state()}


def changed_camera(camera: Camera, change: Array) -> Camera:
    """A camera after a change (6,): rotation vector about its center along the world's axes, radians; shift, world
    units."""
    T = camera.T_cam_world.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(change[:3]).as_matrix().T
    T[:3, 3] = -T[:3, :3] @ (camera.position + change[3:])
    return dataclasses.replace(camera, T_cam_world=T)


def held_out_corrections(refinement: CameraRefinement, dataset: Dataset) -> dict[str, list[float]]:
    """Of each test view of a film, by its name, what its camera is corrected by (`changed_camera`): in time between the
    corrections of the training views around it. Empty for other captures, and where those do not foretell each other.
    """
    views = sorted(dataset.train, key=lambda view: view.time)
    if not dataset.is_film or len(views) < 3:
        return {}
    times, learnt = [view.time for view in views], np.stack([refinement.correction(view.camera) for view in views])
    apart = learnt[1:-1] - (learnt[:-2] + learnt[2:]) / 2
    if np.square(apart).sum() >= np.square(learnt[1:-1]).sum():
        return {}
    return {view.name: [float(np.interp(view.time, times, each)) for each in learnt.T] for view in dataset.test}


def corrected_views(views: Sequence[View], corrections: Mapping[str, Any]) -> list[View]:
    """Views with corrected cameras, where `held_out_corrections` names them. Raises InputError."""
    return [
        view if view.name not in corrections else dataclasses.replace(view, camera=_corrected(view, corrections))
        for view in views
    ]


def _corrected(view: View, corrections: Mapping[str, Any]) -> Camera:
    try:
        change = np.array(corrections[view.name], np.float64)
    except (TypeError, ValueError):
        change = np.array(np.nan)
    if change.shape != (6,) or not np.isfinite(change).all():
        raise InputError(f"metrics.json: training.cameras.test_views.{view.name} is not made of 6 numbers.")
    return changed_camera(view.camera, change)


def _common_motions(cameras: Sequence[Camera], extent: float) -> Array:
    """(6 C, r) orthonormal: changes of all cameras that are a small shift, turn or scaling of the whole scene."""
    arms = np.stack([camera.position for camera in cameras])
    arms = (arms - arms.mean(axis=0)) / extent
    zero = np.zeros_like(arms)
    columns = [np.hstack([zero, arms])]
    for axis in np.eye(3):
        columns += [np.hstack([zero, zero + axis]), np.hstack([zero + axis, np.cross(axis, arms)])]
    basis, sizes, _ = np.linalg.svd(np.stack([column.ravel() for column in columns], axis=1), full_matrices=False)
    return np.ascontiguousarray(basis[:, sizes > 1e-9 * sizes[0]])


def _units(length: float) -> Array:
    """(6,) factors of a rotation vector and a shift that change the unit of the shift."""
    return np.repeat([1.0, length], 3)
