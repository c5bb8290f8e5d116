"""A fit of what stands still: a short training without motion, of small images."""

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
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, Config, changed
from lapgs_wgpu.train.exposure import without_exposure
from lapgs_wgpu.train.trainer import Trainer

MOST_VIEWS = 400  # of a capture, evenly chosen over the clip
# The schedule, in shares of its steps, and the rates are its own: what the static fit is sure of decides what is found.
SCHEDULE = {
    "schedule.sh_interval": 0.375,
    "density.start": 0.375,
    "density.stop": 0.875,
    "density.interval": 0.125,
    "density.contribution_interval": 0.3125,
    "density.reset_interval": 1.0,
}
REFINE = 0.125  # from when on cameras move, at the latest
# The learning rates are those of 3DGS. It is all a warm-up, whose losses, without the pyramid, are L1 and SSIM.
VALUES = {
    "field.kind": "static",
    "rates.log_scales": 5e-3,
    "rates.quats": 1e-3,
    "rates.sh_dc": 2.5e-3,
    "rates.sh_rest": 1.25e-4,
    "density.gradient": 5e-4,
    "density.split": "plain",
    "loss.pyramid": 0.0,
    "schedule.cool_down": 0.0,
    "schedule.half_size_steps": 0,
    "step_place": "auto",
}


class StaticFit(NamedTuple):
    """scene: what stands still. images: the training images of the clip, by time, with their differences from it.
    depths: (H, W) of what stands still in each, world units, NaN where nothing does; None where no masks tell what
    moves. corrections: of the dataset's cameras; None where they are kept."""

    scene: Scene4D
    images: list[Residual]
    depths: list[Floats] | None
    corrections: Corrections | None


def static_config(config: Config) -> Config:
    """The configuration of the static fit for a training."""
    steps = config.discovery.steps
    lengths = {key: max(1, round(share * steps)) for key, share in SCHEDULE.items()}
    lengths |= dict.fromkeys(("schedule.steps", "schedule.warm_up", "rates.means.steps", "cameras.rate.steps"), steps)
    lengths["cameras.start"] = min(config.cameras.start, max(1, round(REFINE * steps)))
    return changed(config, VALUES | lengths)


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
        still = training.scene.render(camera, view.time, background, depth=False).image.numpy(force=True)
        if (correction := training.exposure_of(view)) is not None:
            image = without_exposure(image, correction.numpy(force=True))
        if (ignored := view.load_ignored()) is not None:
            image[ignored] = still[ignored]
        moving = None if view.moving is None else view.moving()
        images.append(Residual(camera, view.time, image, still, moving))
        if moving is not None:
            depths.append(depth_of(training.scene, camera))
    corrections = None
    if refinement is not None:
        pairs = zip(picked, small, strict=True)
        corrections = {before.camera: refinement.correction(after.camera) for before, after in pairs}
    return StaticFit(training.scene, images, depths or None, corrections)


def depth_of(scene: Scene4D, camera: Camera) -> Floats:
    """(H, W) the depth of what stands still, world units, NaN where nothing does: by the mean of inverse depths, to
    which gaps in a surface that show what is far behind it add little."""
    still = scene.canonical()
    depths = camera.project(still.means.numpy(force=True))[1]
    colors = (1 / torch.from_numpy(depths).float().clamp(min=camera.near))[:, None].repeat(1, 3)
    with torch.no_grad():
        of_each = still.means, still.quats, still.scales, still.opacities, colors
        drawn = rasterize(*of_each, camera, antialiased=still.antialiased, device=scene.device)
    alpha, total = drawn.alpha.numpy(force=True), drawn.image[..., 0].numpy(force=True)
    return np.where(alpha > 0.5, alpha / np.maximum(total, 1e-9), np.nan).astype(np.float32)


def _without_movers(view: View) -> View:
    """The view, whose moving pixels the loss leaves out, and two around them."""
    if view.moving is None:
        return view
    moving = ndimage.binary_dilation(view.moving(), iterations=2)
    ignored = view.load_ignored()
    return dataclasses.replace(view, ignored=lambda: moving if ignored is None else moving | ignored)
