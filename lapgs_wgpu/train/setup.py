"""What a training is given, checked against each other and resolved: its configuration, its data and its device."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.open_dataset import open_dataset, resolve_data
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.resolve_config import resolve_for_dataset, resolve_step


class Setup(NamedTuple):
    """What a training works with.

    Attributes:
        user_config: with its field and the place of its steps decided, as config.toml holds it.
        config: the same resolved for the data, too.
        dataset: the capture.
        device: that trains.
    """

    user_config: Config
    config: Config
    dataset: Dataset
    device: Device


def set_up(
    config: Config,
    dataset: Dataset | None,
    device: Device | None,
    parts: Parts,
    scene: Scene4D | None = None,
) -> Setup:
    """Check the arguments of a `Trainer`, open what they leave out, and resolve the configuration.

    The field is that of the scene or of the parts, where they bring one. Raises InputError.
    """
    for name, kind, value in (("config", Config, config), ("dataset", Dataset | None, dataset)):
        if not isinstance(value, kind):
            raise InputError(f"Trainer takes as {name} what load_{name} gives, got a {type(value).__name__}.")
    if scene is not None and parts.field is not None:
        raise InputError("the scene to start from keeps its own field; leave out Parts(field=...).")
    if scene is not None and scene.antialiased != config.antialiased:
        raise InputError(
            f"the scene to start from is drawn with antialiased = {scene.antialiased}, and the configuration says "
            f"{config.antialiased}; give the configuration the scene's."
        )
    if dataset is None:
        config = resolve_data(config, Path("runs"))
        dataset = open_dataset(config)
    device = device or open_device()
    if scene is not None:
        config = dataclasses.replace(config, field=scene.field_config)
    elif parts.field is not None:
        try:
            config = dataclasses.replace(config, field=dataclasses.replace(config.field, kind="own"))
        except ValueError as error:
            raise InputError(f"{error}.") from None
    user_config = resolve_step(config, dataset, device, parts)
    resolved = resolve_for_dataset(user_config, dataset)
    if scene is not None:  # whose field does not change its shape any more
        resolved = dataclasses.replace(resolved, field=scene.field_config)
    return Setup(user_config, resolved, dataset, device)
