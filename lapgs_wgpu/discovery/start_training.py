"""The start of a training: motion discovery where the configuration asks for it, then a Trainer."""

from __future__ import annotations

import sys

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.discovery.discover import discover
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.make_field import check_own
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
    than `discovery.steps`, which a note on stderr tells.

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
    start, steps, needed = None, resolved.schedule.steps, resolved.discovery.steps
    if resolved.discovery.enabled and resolved.field.kind != "static":
        if steps > needed:
            with torch_threads(step_threads(resolved.field, device)):
                start = discover(resolved, dataset, device, parts.field)
        else:
            reason = f"schedule.steps ({steps}) must be larger than discovery.steps ({needed})"
            print(f"note: motion discovery is left out: {reason}.", file=sys.stderr, flush=True)
    return Trainer(user_config, dataset, device, start=start, parts=parts)
