"""A fit of what stands still: a short training without motion, of small images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.data.views import Dataset, View, composite, small_views, spread_views
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.camera_refinement import CameraRefinement, Corrections
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, Config
from lapgs_wgpu.train.discovery.residual import Residual
from lapgs_wgpu.train.exposure import without_exposure
from lapgs_wgpu.train.learning_rate import Rate

MOST_VIEWS = 400  # of a capture, evenly chosen over the clip
# The schedule, in shares of its steps, and the rates are its own: what the static fit is sure of decides what is found.
DENSIFY = (0.375, 0.875)
DENSITY_INTERVAL, CONTRIBUTION_INTERVAL = 0.125, 0.3125
SH_INTERVAL = 0.375
REFINE = 0.125  # from when on cameras move, at the latest
GRADIENT = 5e-4  # density.gradient
LOG_SCALES, QUATS, SH_DC, SH_REST = 5e-3, 1e-3, 2.5e-3, 1.25e-4  # learning rates, those of 3DGS


class StaticTrainer(Protocol):
    """A training, as `Trainer` is one, which starts with a discovery itself and therefore is no import of this file."""

    scene: Scene4D
    cameras: CameraRefinement | None

    def exposure_of(self, view: View) -> Tensor | None: ...
    def step(self) -> object: ...
    def close(self) -> None: ...


MakeTrainer = Callable[[Config, Dataset, Device], StaticTrainer]


class StaticFit(NamedTuple):
    """scene: what stands still. images: the training images of the clip, by time, with their differences from it.
    corrections: of the dataset's cameras; None where they are kept."""

    scene: Scene4D
    images: list[Residual]
    corrections: Corrections | None


def static_fit(
    config: Config, dataset: Dataset, device: Device, trainer: MakeTrainer, progress: Callable[[int], None]
) -> StaticFit:
    """Fit the static scene, and the training cameras where they are refined.

    config: `discovery` says how many steps and at which size; the learning rate of the means is that of the training,
    of whose losses L1 and SSIM are left. progress: called with each step.
    """
    picked = spread_views(dataset.train, MOST_VIEWS)
    small = small_views(picked, config.discovery.size)
    training = trainer(static_config(config), dataclasses.replace(dataset, train=tuple(small)), device)
    try:
        for step in range(config.discovery.steps):
            training.step()
            progress(step + 1)
    finally:
        training.close()
    background, refinement = torch.full((3,), BACKGROUND_LEVELS[config.data.background]), training.cameras
    images = []
    for view in small:
        image = (composite(view.load(), background.numpy()) / 255).astype(np.float32)
        camera = view.camera if refinement is None else refinement.refined(view.camera).camera
        still = training.scene.render(camera, view.time, background, depth=False).image.numpy(force=True)
        if (correction := training.exposure_of(view)) is not None:
            image = without_exposure(image, correction.numpy(force=True))
        if (ignored := view.load_ignored()) is not None:
            image[ignored] = still[ignored]
        images.append(Residual(camera, view.time, image, still))
    corrections = None
    if refinement is not None:
        known = {id(before.camera): after.camera for before, after in zip(picked, small, strict=True)}
        numbers = {n: known[id(camera)] for n, camera in enumerate(dataset.cameras) if id(camera) in known}
        corrections = refinement.corrections_of(numbers)
    return StaticFit(training.scene, images, corrections)


def static_config(config: Config) -> Config:
    """The configuration of the static fit for a training."""
    steps = config.discovery.steps
    return dataclasses.replace(
        config,
        field=dataclasses.replace(config.field, kind="static"),
        schedule=dataclasses.replace(
            config.schedule, steps=steps, batch=1, warm_up=steps, sh_interval=max(1, round(SH_INTERVAL * steps))
        ),
        rates=dataclasses.replace(
            config.rates,
            means=Rate(config.rates.means.start, config.rates.means.end, steps),
            log_scales=LOG_SCALES,
            quats=QUATS,
            sh_dc=SH_DC,
            sh_rest=SH_REST,
        ),
        density=dataclasses.replace(
            config.density,
            start=round(DENSIFY[0] * steps),
            stop=round(DENSIFY[1] * steps),
            interval=max(1, round(DENSITY_INTERVAL * steps)),
            contribution_interval=max(1, round(CONTRIBUTION_INTERVAL * steps)),
            reset_interval=steps,
            gradient=GRADIENT,
            split="plain",
        ),
        cameras=dataclasses.replace(
            config.cameras,
            rate=dataclasses.replace(config.cameras.rate, steps=steps),
            start=min(config.cameras.start, max(1, round(REFINE * steps))),
        ),
        loss=dataclasses.replace(config.loss, pyramid=0.0, ncc=0.0, dynamics_mode="off"),
        smoothness=dataclasses.replace(config.smoothness, share=0.0),
        acceleration=dataclasses.replace(config.acceleration, weight=0.0),
        precision="float32",
        decoder="torch",
    )
