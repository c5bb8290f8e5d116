"""A fit of what stands still: a short training without motion, of small images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage

from lapgs_wgpu.data.views import Dataset, View, composite, small_views, spread_views
from lapgs_wgpu.discovery.residual import Floats, Residual
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, Config
from lapgs_wgpu.train.exposure import without_exposure
from lapgs_wgpu.train.static_config import static_config
from lapgs_wgpu.train.trainer import Trainer

MOST_VIEWS = 400  # of a capture, evenly chosen over the clip
RIM = 2  # pixels around what moves that the fit does not look at, either
SOLID = 0.5  # alpha from which on something is there


class StaticFit(NamedTuple):
    """scene: what stands still. images: the training images of the clip, by time, with their differences from it.
    depths: (H, W) of what stands still in each, world units, NaN where nothing does; None where no masks tell what
    moves. corrections: of the dataset's cameras; None where they are kept."""

    scene: Scene4D
    images: list[Residual]
    depths: list[Floats] | None
    corrections: Corrections | None


def static_fit(config: Config, dataset: Dataset, device: Device, progress: Callable[[int], None]) -> StaticFit:
    """Fit the static scene, and the training cameras where they are refined.

    config: `discovery` says how many steps and at which size; the learning rate of the means is that of the training,
    of whose losses L1 and SSIM are left. progress: called with each step.
    """
    picked = spread_views(dataset.train, MOST_VIEWS)
    small = small_views(picked, config.discovery.size)
    fitted = tuple(_without_movers(view) for view in small)
    with Trainer(static_config(config), dataclasses.replace(dataset, train=fitted), device) as training:
        for result in training:
            progress(result.step)
    background, refinement = torch.full((3,), BACKGROUND_LEVELS[config.data.background]), training.cameras
    images, depths = [], []
    for view in small:
        image = (composite(view.load(), background.numpy()) / 255).astype(np.float32)
        camera = view.camera if refinement is None else refinement.refined(view.camera)
        rendering = training.scene.render(camera, view.time, background, depth=view.moving is not None)
        still = rendering.image.numpy(force=True)
        if (correction := training.exposure_of(view)) is not None:
            image = without_exposure(image, correction.numpy(force=True))
        if (ignored := view.load_ignored()) is not None:
            image[ignored] = still[ignored]
        moving = None if view.moving is None else view.moving()
        images.append(Residual(camera, view.time, image, still, moving))
        if moving is not None:
            alpha = rendering.alpha.numpy(force=True)
            depths.append(np.where(alpha > SOLID, rendering.depth.numpy(force=True) / np.maximum(alpha, SOLID), np.nan))
    corrections = None
    if refinement is not None:
        known = {before.camera: after.camera for before, after in zip(picked, small, strict=True)}
        numbers = {n: known[camera] for n, camera in enumerate(dataset.cameras) if camera in known}
        corrections = refinement.corrections_of(numbers)
    return StaticFit(training.scene, images, depths or None, corrections)


def _without_movers(view: View) -> View:
    """The view, whose moving pixels the loss leaves out."""
    if view.moving is None:
        return view
    moving = ndimage.binary_dilation(view.moving(), iterations=RIM)
    ignored = view.load_ignored()
    return dataclasses.replace(view, ignored=lambda: moving if ignored is None else moving | ignored)
