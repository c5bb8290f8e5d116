"""The rendered walk past a room as a dataset whose training poses are disturbed, and how far they are off."""

from collections.abc import Sequence

import numpy as np
from helpers.films import Board, drawn, room_cloud, walk
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.camera_refinement import _common_motions, changed_camera

SCALE, CENTER = 0.4, np.array([0.5, 0.3, 0.4])  # the room fills the presets' cube
CLOUD_NOISE = 0.01  # of the cameras' extent


def disturbed(cameras: Sequence[Camera], degrees: float, percent: float, seed: int = 1) -> list[Camera]:
    """Each camera turned about its own axis and shifted in its own direction, by this much; per cent of the extent."""
    rng = np.random.default_rng(seed)
    found = []
    for camera in cameras:
        turn, shift = rng.normal(size=(2, 3))
        turn *= np.radians(degrees) / np.linalg.norm(turn)
        shift *= percent / 100 * extent_of(cameras) / np.linalg.norm(shift)
        found.append(changed_camera(camera, np.concatenate([turn, shift])))
    return found


def extent_of(cameras: Sequence[Camera]) -> float:
    places = np.stack([camera.position for camera in cameras])
    return 1.1 * float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())


def turn_between(a: Camera, b: Camera) -> NDArray[np.float64]:
    """(3,) rotation vector, radians."""
    return Rotation.from_matrix(a.T_cam_world[:3, :3].T @ b.T_cam_world[:3, :3]).as_rotvec()


def pose_errors(cameras: Sequence[Camera], true: Sequence[Camera]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of each camera the turn, degrees, and the shift, per cent of the extent, by which it is off.

    What a shift, a turn and a scaling of the whole scene explain does not count.
    """
    extent = extent_of(true)
    off = np.concatenate(
        [[*turn_between(a, b), *((a.position - b.position) / extent)] for a, b in zip(cameras, true, strict=True)]
    )
    common = _common_motions(true, extent)
    off = (off - common @ (common.T @ off)).reshape(-1, 6)
    return np.degrees(np.linalg.norm(off[:, :3], axis=1)), 100 * np.linalg.norm(off[:, 3:], axis=1)


def disturbed_walk(
    width: int, count: int, degrees: float, percent: float, board: Board | None = None, *, seed: int = 1
) -> tuple[Dataset, list[Camera]]:
    """The dataset, with a noisy cloud and true test cameras, and the true training cameras. Images have 4:3."""
    board, placed = board or Board(), Normalization(CENTER, SCALE)
    every = walk(2 * count - 1, width, width * 3 // 4)
    times = np.linspace(0, 1, len(every))

    def view(split: str, number: int, camera: Camera) -> View:
        pixels = drawn(every[number], times[number], board)[0]
        return View(f"{split}_{number:03d}", camera, float(times[number]), "the rendered walk", pixels.copy)

    true = [placed.camera(camera) for camera in every[::2]]
    training = [view("train", 2 * i, camera) for i, camera in enumerate(disturbed(true, degrees, percent, seed))]
    test = [view("test", i, placed.camera(every[i])) for i in range(5, len(every), 8)]
    points, colors = room_cloud(2000, CLOUD_NOISE * extent_of(every))
    cloud = placed.cloud(Cloud(points.astype(np.float32), colors.astype(np.float32)))
    return Dataset("walk", tuple(training), tuple(test), cloud=cloud, own_footage=True), true
