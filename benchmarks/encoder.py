"""The hash encoder at a preset's sizes, against its torch reference in the same run."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from helpers.encoder_reference import encode_reference
from measure import Timing, timed
from numpy.typing import NDArray
from passes import Meter, PassTimes
from torch import Tensor
from work import encoder_work

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.fields.hash_encoder import HashEncoder

TIME = 0.37


@dataclass(frozen=True)
class EncoderReport:
    """forward, forward_backward: our kernels through autograd. reference_...: the same in torch alone, in float32."""

    points: int
    levels: int
    entries: int
    forward: Timing
    forward_backward: Timing
    reference_forward: Timing
    reference_forward_backward: Timing
    passes: PassTimes | None
    largest_difference: float  # of the gradients, relative to the largest gradient of a grid's table


def bench_encoder(
    device: Device, config: FieldConfig, means: NDArray[np.float32], meter: Meter | None, repeat: int
) -> EncoderReport:
    """Encode the means with all four grids of the field."""
    grids = GridField(config, device, seed=0).grids
    encoder = HashEncoder(device, [[grid] for grid in grids], config.bound)
    tables = [grid.table for grid in grids]
    points = torch.from_numpy(means)
    generator = torch.Generator().manual_seed(0)
    d_encodings = [torch.randn(len(points), grid.features, generator=generator) for grid in grids]

    def kernels() -> list[Tensor]:
        return encoder.encode_all([(points, TIME)])[0]

    def reference() -> list[Tensor]:
        return [encode_reference(grid, grid.table, points, TIME, config.bound) for grid in grids]

    def gradients(encode: Callable[[], list[Tensor]]) -> list[Tensor]:
        return list(torch.autograd.grad(encode(), tables, d_encodings))

    def forward(encode: Callable[[], list[Tensor]]) -> Callable[[], object]:
        return torch.no_grad()(encode)

    pairs = zip(gradients(kernels), gradients(reference), strict=True)
    differences = [float((ours - theirs).abs().max() / theirs.abs().max()) for ours, theirs in pairs]
    work = encoder_work(grids, len(points), lane_levels=device.is_cpu)
    reference_repeat = max(1, repeat // 3)  # it takes seconds, and has run once to be compared
    return EncoderReport(
        points=len(points),
        levels=sum(len(grid.levels) for grid in grids),
        entries=sum(len(table) for table in tables),
        forward=timed(forward(kernels), repeat),
        forward_backward=timed(lambda: gradients(kernels), repeat),
        reference_forward=timed(forward(reference), reference_repeat, warm_up=0),
        reference_forward_backward=timed(lambda: gradients(reference), reference_repeat, warm_up=0),
        passes=meter(lambda: gradients(kernels), work, repeat) if meter else None,
        largest_difference=max(differences),
    )
