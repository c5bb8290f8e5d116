"""The start of a training: motion discovery where the configuration asks for it, then a Trainer."""

from __future__ import annotations

import sys

from torch import nn

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.discovery.discover import discover
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.own_field import check_own
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.host import step_threads, torch_threads
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.setup import set_up
from lapgs_wgpu.train.trainer import Trainer


def start_training(
    config: Config,
    dataset: Dataset | None = None,
    device: Device | None = None,
    *,
    parts: Parts | None = None,
) -> Trainer:
    """Do motion discovery as the configuration says, and make the trainer that starts from what it finds.

    Discovery is left out where `discovery.enabled` is false, the field is static, or `schedule.steps` is not larger
    than `discovery.steps`. Notes on stderr tell that, and what the training will not do because it ends before.

    Args:
        config: as `load_config` gives it.
        dataset: None for the one that config.data names; a built-in scene is then written into the folder runs.
        device: None for the default adapter.
        parts: own field, losses, density control, learning rates and callbacks.

    Returns:
        The trainer before its first step.

    Raises:
        InputError: the configuration, the data and the parts do not fit each other, or the images show nothing.
    """
    parts = parts or Parts()
    user_config, resolved, dataset, device = set_up(config, dataset, device, parts)
    check_own(resolved.field, parts.field)
    start, notes = None, []
    if resolved.discovery.enabled and resolved.field.kind != "static":
        if reason := _no_discovery(resolved, parts.field):
            notes.append(f"motion discovery is left out: {reason}")
        else:
            with torch_threads(step_threads(resolved.field, device)):
                start = discover(resolved, dataset, device, parts.field)
    trainer = Trainer(user_config, dataset, device, start=start, parts=parts)
    for note in [*notes, *_unused_settings(trainer)]:
        print(f"note: {note}", file=sys.stderr, flush=True)
    return trainer


def _no_discovery(config: Config, own_field: nn.Module | None) -> str:
    """Why motion discovery is left out although it is enabled, a sentence; empty where it is done."""
    steps, needed = config.schedule.steps, config.discovery.steps
    if steps <= needed:
        return f"schedule.steps ({steps}) must be larger than discovery.steps ({needed})."
    if own_field is not None and not any(parameter.requires_grad for parameter in own_field.parameters()):
        return f"the field {type(own_field).__name__} has no parameters that could learn what it finds."
    return ""


def _unused_settings(trainer: Trainer) -> list[str]:
    """Sentences on what a training will not do, because its schedule ends before."""
    config, notes = trainer.config, []
    if trainer.scene.field is None:
        return []
    steps = config.schedule.steps
    if trainer.warm_up_steps >= steps:
        notes.append(
            f"nothing moves in this training, since its warm-up (schedule.warm_up: {trainer.warm_up_steps} steps) is "
            f"not shorter than schedule.steps ({steps})."
        )
    if config.timing.refine and config.timing.start >= steps:
        notes.append(
            f"no times are corrected in this training, since timing.start ({config.timing.start}) is not below "
            f"schedule.steps ({steps})."
        )
    return notes
