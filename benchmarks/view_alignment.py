"""Test-time alignment: the camera of a held-out view, fitted to its image while the scene stays as it is.

Where training cameras are refined, the scene lies in their coordinates, and the poses of test views are as far off as
those of the training views were. Methods that refine poses measure test views after such a fit (BARF, Lin et al. 2021).
"""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.camera_refinement import CameraDescent, changed_camera, image_motion, scene_points, whitening
from lapgs_wgpu.train.config import LossWeights, Rate
from lapgs_wgpu.train.exchange_step import render_loss
from lapgs_wgpu.train.ground_truth import marked_pixels, upload_rgba
from lapgs_wgpu.train.optimizer import rate_at

STEPS = 24
RATE = Rate(4e-3, 2e-4, STEPS)  # radians of image motion: 1.5 degrees together
DAMPING = (1.0, 0.02)  # from the first step to the last
WEIGHTS = LossWeights(l1=0.8, ssim=0.2)


def aligned_view(scene: Scene4D, view: View, background: Tensor, unit: float) -> View:
    """The view with the camera that fits its image best, near its own; the field of view stays.

    background: (3,) behind the scene and behind a transparent image. unit: extent of the cameras, world units. The same
    bits on every run of one adapter and driver. Raises InputError where the image cannot be read.
    """
    with torch.no_grad():
        gaussians = scene.at(view.time)
    points = scene_points(gaussians.means, gaussians.opacities)
    truth = upload_rgba(scene.device, marked_pixels(view, background))
    descent, camera = CameraDescent(1), view.camera
    for step in range(1, STEPS + 1):
        change = torch.zeros(6, requires_grad=True)
        render_loss(
            gaussians, camera, truth, background, WEIGHTS, scene.device, camera_change=change, camera_unit=unit
        ).loss.backward()
        if change.grad is None or not bool(change.grad.isfinite().all()):
            break
        damping = DAMPING[0] ** (1 - step / STEPS) * DAMPING[1] ** (step / STEPS)
        whiten = whitening(image_motion(camera, points, unit), damping)
        move = descent.change(0, change.grad.double().numpy(), whiten, rate_at(RATE, step))
        camera = changed_camera(camera, move * np.repeat([1.0, unit], 3))
    return dataclasses.replace(view, camera=camera)
