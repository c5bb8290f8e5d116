"""Opacities for players that draw without antialiasing."""

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.splat.camera import rotation_matrix
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.viewer.loaded_scene import LoadedScene


def plain_factors(scene: LoadedScene) -> NDArray[np.floating]:
    """Return the factors (N,) of opacities with which plain drawing comes nearest to the scene's own.

    They are 1 where the scene is not antialiased. Antialiased drawing makes a splat as much fainter as the low-pass
    filter makes it larger, which depends on its size in the image: here the median over eight views around the focus,
    each at another time of the clip, in the size of the captured images and at the distance of the first of them.
    """
    if not scene.playback.at(0.0).antialiased:
        return np.ones(scene.playback.count)
    factors = []
    for camera, t in scene.around(8, None):
        now = scene.playback.at(t)
        means, quats, scales = read_all([now.means, now.quats, now.scales])
        R = camera.T_cam_world[:3, :3]
        local = means @ R.T + camera.T_cam_world[:3, 3]
        ahead = local[:, 2] > 0
        x, y, z = np.where(ahead, local.T, 1.0)
        fx, fy, zero = camera.K[0, 0] / z, camera.K[1, 1] / z, np.zeros(len(z))
        J = np.array([[fx, zero, -fx * x / z], [zero, fy, -fy * y / z]]).transpose(2, 0, 1)
        unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        axes = J @ R @ rotation_matrix(unit.T).transpose(2, 0, 1) * scales[:, None, :]
        covariance = axes @ axes.transpose(0, 2, 1)
        larger = covariance + CONSTANTS["DILATION"] * np.eye(2)
        # The roots of the areas without and with the low-pass filter.
        faded = np.sqrt(np.linalg.det(covariance).clip(0) / np.linalg.det(larger))
        factors.append(np.where(ahead, faded, 1.0))
    return np.asarray(np.median(factors, axis=0))
