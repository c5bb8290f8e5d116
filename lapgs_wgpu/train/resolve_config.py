"""What a configuration leaves to the data and to the device."""

from __future__ import annotations

import dataclasses
import math

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.timing import MOST_TIMES
from lapgs_wgpu.train.config import Config


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


def resolve_decoder(config: Config, device: Device) -> Config:
    """The configuration with the decoder's place, which "auto" leaves open, decided.

    It is the device where kernels for it exist, but for CPU devices: they share torch's processor, which torch makes
    ten times more of. No trial decides, since the place changes the last bits, and near a tie two runs would differ.
    """
    if config.decoder != "auto":
        return config
    able = config.field.decodes_on_device
    return dataclasses.replace(config, decoder="device" if able and not device.is_cpu else "torch")
