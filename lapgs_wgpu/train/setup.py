"""What a training is given, opened and checked; and what its configuration leaves to the data and the device."""

from __future__ import annotations

import dataclasses
import math
import operator
from pathlib import Path

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.built_in import SYNTHETIC, write_built_in
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import MOST_TIMES
from lapgs_wgpu.train.config import Config, changed
from lapgs_wgpu.train.parts import Parts


def set_up(
    config: Config,
    dataset: Dataset | None,
    device: Device | None,
    parts: Parts,
    scene: Scene4D | None = None,
) -> tuple[Config, Config, Dataset, Device]:
    """Check the arguments of a `Trainer`, open what they leave out, and resolve the configuration.

    Returns the configuration with its field, that of the scene or of the parts where they bring one, and the place of
    its steps decided, as config.toml holds it; the same resolved for the data, too; the capture; the device. Raises
    InputError where the arguments do not fit each other.
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
            config = changed(config, {"field.kind": "own"})
        except ValueError as error:
            raise InputError(f"{error}.") from None
    user_config = resolve_step(config, device, parts)
    resolved = resolve_for_dataset(user_config, dataset)
    if scene is not None:  # whose field does not change its shape any more
        resolved = dataclasses.replace(resolved, field=scene.field_config)
    return user_config, resolved, dataset, device


def resolve_data(config: Config, scenes: Path) -> Config:
    """The configuration with the absolute paths of its data. scenes: folder into which the built-in scene is written,
    unless it is there. Raises InputError."""
    path = config.data.path
    if not path:
        raise InputError(f"the configuration names no data; give --data DIR (in Python data.path), or {SYNTHETIC}.")
    folder = write_built_in(scenes / SYNTHETIC) if path == SYNTHETIC else Path(path)
    masks = str(Path(config.data.masks).resolve()) if config.data.masks else ""
    return changed(config, {"data.path": str(folder.resolve()), "data.masks": masks})


def open_dataset(config: Config) -> Dataset:
    """The dataset of a configuration whose path is a folder's. Raises InputError."""
    data = config.data
    return load_dataset(
        data.path,
        image_size=data.size or None,
        undistort=data.undistort,
        masks=data.masks or None,
        movers=data.movers or None,
    )


def resolve_for_dataset(config: Config, dataset: Dataset) -> Config:
    """The configuration with lengths in world units, and no more frequencies than the training times can tell apart.

    Raises InputError where the data do not allow it.
    """
    if config.timing.refine and len(dataset.times) > MOST_TIMES:
        raise InputError(
            f"{dataset.name} has {len(dataset.times)} times, and timing.refine takes {MOST_TIMES} at most; give "
            "--timing.refine false."
        )
    if config.data.units == "capture":
        lengths = ("field.bound", "field.unit", "rates.means.start", "rates.means.end", "smoothness.reach")
        scaled = {key: dataset.scale * operator.attrgetter(key)(config) for key in lengths}
        config = changed(config, {**scaled, "data.units": "world"})
    # All frequencies above the limit would end there.
    most = 1 + math.floor(nyquist_frequency(dataset) / config.field.frequency_step + 1e-9)
    return changed(config, {"field.components": min(config.field.components, most)})


def nyquist_frequency(dataset: Dataset) -> float:
    """Half the rate of the training times, cycles over the clip: above it a frequency looks like one below."""
    times = dataset.times
    return (len(times) - 1) / 2 / float(times[-1] - times[0]) if len(times) > 1 else 0.0


def resolve_step(config: Config, device: Device, parts: Parts) -> Config:
    """The configuration with the place of the step, which "auto" leaves open, decided.

    No trial decides, since the place changes the last bits, and near a tie two runs would differ. Raises InputError
    where it is to be resident and cannot be.
    """
    reason = why_exchange(config, parts)
    if config.step_place == "resident" and reason:
        raise InputError(f"the step cannot be resident: {reason}; give --step_place auto.")
    if config.step_place != "auto":
        return config
    return dataclasses.replace(config, step_place="exchange" if reason or device.is_cpu else "resident")


def why_exchange(config: Config, parts: Parts) -> str:
    """What of a training only torch can compute; "" where there is nothing."""
    if config.field.kind != "static" and not config.field.decodes_on_device:
        return f"there are no kernels for the field {config.field.kind} in this shape"
    if parts.losses:
        return "losses of one's own are torch's"
    return ""
