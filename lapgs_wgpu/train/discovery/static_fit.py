"""A fit of what stands still: a short training without motion, of small images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.data.images import shrink
from lapgs_wgpu.data.views import Dataset, View, composite
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Config, Rate
from lapgs_wgpu.train.evaluate import BACKGROUND_LEVELS

from .residual import Residual

MOST_VIEWS = 400  # of a capture, evenly chosen over the clip
# The schedule, in shares of its steps, and the rates are its own: what the static fit is sure of decides what is found.
DENSIFY = (0.375, 0.875)
DENSITY_INTERVAL, CONTRIBUTION_INTERVAL = 0.125, 0.3125
SH_INTERVAL = 0.375
GRADIENT = 5e-4  # density.gradient
LOG_SCALES, QUATS, SH_DC, SH_REST = 5e-3, 1e-3, 2.5e-3, 1.25e-4  # learning rates, those of 3DGS


class StaticTrainer(Protocol):
    """A training, as `Trainer` is one, which starts with a discovery itself and therefore is no import of this file."""

    scene: Scene4D

    def step(self) -> object: ...
    def close(self) -> None: ...


MakeTrainer = Callable[[Config, Dataset, Device], StaticTrainer]


def static_fit(
    config: Config, dataset: Dataset, device: Device, trainer: MakeTrainer, progress: Callable[[int], None]
) -> tuple[Scene4D, list[Residual]]:
    """The static scene, and the training images of the clip, by time, with their differences from it.

    config: `discovery` says how many steps and at which size; the learning rate of the means and the losses are those
    of the training, but for the terms that compare the field. progress: called with each step.
    """
    views = sorted(dataset.train, key=lambda view: (view.time, view.name))
    chosen = np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).astype(np.int64)
    small = [small_view(views[i], config.discovery.size) for i in dict.fromkeys(chosen.tolist())]
    training = trainer(static_config(config), dataclasses.replace(dataset, train=tuple(small)), device)
    try:
        for step in range(config.discovery.steps):
            training.step()
            progress(step + 1)
    finally:
        training.close()
    background = torch.full((3,), BACKGROUND_LEVELS[config.data.background])
    images = []
    for view in small:
        image = (composite(view.load(), background.numpy()) / 255).astype(np.float32)
        still = training.scene.render(view.camera, view.time, background, depth=False).image.numpy(force=True)
        images.append(Residual(view.camera, view.time, image, still))
    return training.scene, images


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
        loss=dataclasses.replace(config.loss, pyramid=0.0, ncc=0.0, dynamics_mode="off"),
        smoothness=dataclasses.replace(config.smoothness, share=0.0),
        precision="float32",
        decoder="torch",
    )


def small_view(view: View, size: int) -> View:
    """The view with its longer side shrunk to `size` pixels; the view itself where it is no larger."""
    width, height = view.camera.width, view.camera.height
    scale = size / max(width, height)
    if scale >= 1:
        return view
    small = max(1, round(scale * width)), max(1, round(scale * height))
    return dataclasses.replace(view, camera=view.camera.resized(*small), pixels=partial(_shrunk, view, small))


def _shrunk(view: View, size: tuple[int, int]) -> NDArray[np.uint8]:
    return shrink(view.load(), size)
