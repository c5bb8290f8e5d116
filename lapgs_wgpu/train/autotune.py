"""Where a training's decoder works: in torch, or on the device, whichever is faster."""

from __future__ import annotations

import math
import statistics
import time
from typing import Literal, NamedTuple

import torch

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.distributed import Ranks

Where = Literal["torch", "device"]
_ROUNDS = 3  # of each, after one that compiles kernels and makes buffers


class Choice(NamedTuple):
    """Where it works, and how long the field took in each place, forward and backward, in seconds; none where none was
    timed."""

    place: Where
    seconds: dict[Where, float]


def choose_decoder(config: Config, scene: Scene4D, device: Device, ranks: Ranks) -> Choice:
    """What the configuration says or, with "auto", the faster place for the field of a scene at its start.

    With "auto" a CPU device is not timed: it shares torch's processor, which torch makes ten times more of. A device
    whose memory is too small for it takes forever. All ranks choose alike. Moves no random numbers, and leaves no
    gradients.
    """
    field = scene.field
    if config.decoder != "auto":
        return Choice(config.decoder, {})
    allowed = config.field.decodes_on_device and config.precision == "float32"
    if device.is_cpu or not allowed or not isinstance(field, GridField):
        return Choice("torch", {})
    seconds = [_seconds(scene, field, "torch")]
    try:
        seconds.append(_seconds(scene, field, "device"))
    except DeviceMemoryError:
        seconds.append(math.inf)
    of_all = ranks.sums([torch.tensor(seconds, dtype=torch.float64)])[0] / ranks.count
    taken: dict[Where, float] = {"torch": float(of_all[0]), "device": float(of_all[1])}
    return Choice("device" if taken["device"] < taken["torch"] else "torch", taken)


def _seconds(scene: Scene4D, field: GridField, place: Where) -> float:
    """Of the field's forward and backward pass."""
    parameters = scene.parameters
    before, field.on_device = field.on_device, place == "device"
    times = []
    try:
        for _ in range(1 + _ROUNDS):
            start = time.perf_counter()
            move = field(parameters["means"], 0.5, parameters.get("dynamics"))
            torch.cat([part for part in (move.translation, move.d_scales) if part is not None]).sum().backward()
            times.append(time.perf_counter() - start)
    finally:
        field.on_device = before
        for each in (*field.parameters(), *parameters.values()):
            each.grad = None
    return statistics.median(times[1:])
