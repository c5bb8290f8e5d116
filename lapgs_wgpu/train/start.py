"""Where a training starts: from a given scene, from what motion discovery finds, or from initial points."""

from __future__ import annotations

import os
import sys
from typing import NamedTuple

from torch import nn

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.make_field import check_own
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.discovery.discover import discover
from lapgs_wgpu.train.discovery.static_fit import MakeTrainer
from lapgs_wgpu.train.distributed import Ranks
from lapgs_wgpu.train.host_threads import step_threads, torch_threads
from lapgs_wgpu.train.initial_points import initial_points

RISE = 200  # steps over which rates rise after discovery, where schedule.warm_up is 0


class Start(NamedTuple):
    """What a training starts with.

    Attributes:
        scene: the first Gaussians, and the field.
        warm_up: number of the first steps without motion.
        rising: number of the first steps over which the learning rates rise from 0.
        field_fitted: whether discovery has fitted the field to nearly all that moves.
        corrections: of the training cameras, by discovery; None where it left them.
        discovery: what discovery found, a sentence; None where it was left out.
        seconds: that discovery took.
    """

    scene: Scene4D
    warm_up: int
    rising: int
    field_fitted: bool = False
    corrections: Corrections | None = None
    discovery: str | None = None
    seconds: float = 0.0


def start(
    config: Config,
    dataset: Dataset,
    device: Device,
    trainer: MakeTrainer,
    ranks: Ranks,
    *,
    scene: Scene4D | None,
    own_field: nn.Module | None,
    resumed: bool,
) -> Start:
    """Do motion discovery as the configuration says, and make the first Gaussians.

    A scene that is given, or that discovery found, moves from the first step on. After discovery the rates rise first:
    Adam's first steps, all of the size of the rate, would shake off what the field knows.

    Args:
        config: resolved for the dataset.
        dataset: the capture.
        device: that trains.
        trainer: makes the training of discovery's static fit.
        ranks: this process among those that train together.
        scene: to start from, without discovery.
        own_field: of Scene4D.
        resumed: leave out discovery, since a saved state replaces the scene.

    Raises:
        InputError: the images show nothing, the field has no module, or the scene is drawn otherwise than the
            configuration says.
    """
    warm_up = config.schedule.warm_up
    if scene is not None:
        if scene.antialiased != config.antialiased:
            raise InputError(
                f"the scene to start from is drawn with antialiased = {scene.antialiased}, and the configuration says "
                f"{config.antialiased}; give the configuration the scene's."
            )
        return Start(scene, 0, warm_up)
    check_own(config.field, own_field)  # before discovery
    if config.discovery.enabled and config.field.kind != "static" and not resumed:
        reason = _no_discovery(config, own_field)
        if not reason:
            with open(os.devnull, "w") as nowhere, torch_threads(step_threads(config.field, device)):
                found = discover(config, dataset, device, trainer, None if ranks.first else nowhere, own_field)
            of_discovery = (found.field_fitted, found.corrections, found.summary, found.seconds)
            return Start(found.scene, 0, warm_up or RISE, *of_discovery)
        _note(f"motion discovery is left out: {reason}", ranks)
    points = Scene4D.from_points(
        *initial_points(config.points, dataset, config.seed),
        config.field,
        opacity=config.points.opacity,
        antialiased=config.antialiased,
        device=device,
        seed=config.seed,
        own_field=own_field,
    )
    return Start(points, warm_up, 0)


def warn_unused_settings(config: Config, first: Start, ranks: Ranks) -> None:
    """Tell what a training will not do, because its schedule ends before."""
    steps, moves = config.schedule.steps, first.scene.field is not None
    if moves and first.warm_up >= steps:
        _note(
            f"nothing moves in this training, since its warm-up (schedule.warm_up: {first.warm_up} steps) is not "
            f"shorter than schedule.steps ({steps}).",
            ranks,
        )
    if moves and config.timing.refine and config.timing.start >= steps:
        _note(
            f"no times are corrected in this training, since timing.start ({config.timing.start}) is not below "
            f"schedule.steps ({steps}).",
            ranks,
        )


def _note(text: str, ranks: Ranks) -> None:
    """Tell, once among all ranks."""
    if ranks.first:
        print(f"note: {text}", file=sys.stderr, flush=True)


def _no_discovery(config: Config, own_field: nn.Module | None) -> str:
    """Why motion discovery is left out although it is enabled, a sentence; empty where it is done."""
    steps, needed = config.schedule.steps, config.discovery.steps
    if steps <= needed:
        return f"schedule.steps ({steps}) must be larger than discovery.steps ({needed})."
    if own_field is not None and not any(each.requires_grad for each in own_field.parameters()):
        return f"the field {type(own_field).__name__} has no parameters that could learn what it finds."
    return ""
