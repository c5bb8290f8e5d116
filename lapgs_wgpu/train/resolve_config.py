"""What a configuration leaves to the data and to the device."""

from __future__ import annotations

import dataclasses
import math

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.timing import MOST_TIMES
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.parts import Parts


def resolve_for_dataset(config: Config, dataset: Dataset) -> Config:
    """The configuration with lengths in world units, and no more frequencies than the training times can tell apart.

    Raises InputError where the data do not allow it.
    """
    if config.timing.refine and len(dataset.times) > MOST_TIMES:
        raise InputError(
            f"{dataset.name} has {len(dataset.times)} times, and timing.refine takes {MOST_TIMES} at most; give "
            "--timing.refine false."
        )
    field = config.field
    if config.data.units == "capture":
        scale, means = dataset.scale, config.rates.means
        field = dataclasses.replace(field, bound=scale * field.bound, unit=scale * field.unit)
        config = dataclasses.replace(
            config,
            data=dataclasses.replace(config.data, units="world"),
            rates=dataclasses.replace(
                config.rates, means=dataclasses.replace(means, start=scale * means.start, end=scale * means.end)
            ),
            smoothness=dataclasses.replace(config.smoothness, reach=scale * config.smoothness.reach),
        )
    # All frequencies above the limit would end there.
    most = 1 + math.floor(nyquist_frequency(dataset) / field.frequency_step + 1e-9)
    return dataclasses.replace(config, field=dataclasses.replace(field, components=min(field.components, most)))


def nyquist_frequency(dataset: Dataset) -> float:
    """Half the rate of the training times, cycles over the clip: above it a frequency looks like one below."""
    times = dataset.times
    return (len(times) - 1) / 2 / float(times[-1] - times[0]) if len(times) > 1 else 0.0


def resolve_step(config: Config, dataset: Dataset, device: Device, parts: Parts) -> Config:
    """The configuration with the place of the step, which "auto" leaves open, decided.

    No trial decides, since the place changes the last bits, and near a tie two runs would differ. Raises InputError
    where it is to be resident and cannot be.
    """
    reason = why_exchange(config, dataset, parts)
    if config.step_place == "resident" and reason:
        raise InputError(f"the step cannot be resident: {reason}; give --step_place auto.")
    if config.step_place != "auto":
        return config
    return dataclasses.replace(config, step_place="exchange" if reason or device.is_cpu else "resident")


def why_exchange(config: Config, dataset: Dataset, parts: Parts) -> str:
    """What of a training only torch can compute; "" where there is nothing."""
    if config.field.kind != "static" and not config.field.decodes_on_device:
        return f"there are no kernels for the field {config.field.kind} in this shape"
    if parts.losses:
        return "losses of one's own are torch's"
    return ""
