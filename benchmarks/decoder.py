"""The field of a preset, forward and backward, with its decoder in torch and on the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from measure import Timing, timed
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.grid_field import GridField

TIME = 0.37


@dataclass(frozen=True)
class DecoderReport:
    """largest_difference: of a parameter's gradients, relative to their size, as vectors. Of 38 million values before a
    relu some lie so close to zero that the two places disagree on their sign: 1e-4 each, in what has its gradient."""

    gaussians: int
    torch: Timing
    device: Timing
    largest_difference: float


def bench_decoder(device: Device, config: FieldConfig, means: NDArray[np.float32], repeat: int) -> DecoderReport:
    """Encoder included, whose features come to the host only with the decoder in torch. On a CPU device the kernels,
    which take seconds there, run once."""
    field = GridField(config, device, seed=0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in field.parameters():  # zero heads would have zero gradients before them
            parameter.normal_(0.0, 0.1, generator=generator)
    points = torch.from_numpy(means)
    dynamics = torch.zeros(len(points), config.dynamics_size, requires_grad=True)
    outputs = torch.randn(len(points), 3, generator=generator)

    def gradients(*, on_device: bool) -> list[Tensor]:
        field.on_device = on_device
        move = field(points, TIME, dynamics)
        return list(
            torch.autograd.grad((move.translation * outputs).sum(), list(field.parameters()), allow_unused=True)
        )

    pairs = zip(gradients(on_device=False), gradients(on_device=True), strict=True)
    differences = [float((a - b).norm() / a.norm().clamp(min=1e-30)) for a, b in pairs if a is not None]
    runs, warm_up = (1, 0) if device.is_cpu else (repeat, 2)
    return DecoderReport(
        gaussians=len(points),
        torch=timed(lambda: gradients(on_device=False), repeat),
        device=timed(lambda: gradients(on_device=True), runs, warm_up=warm_up),
        largest_difference=max(differences),
    )
