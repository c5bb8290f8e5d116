"""Matrices on the device."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_wgpu.gpu.buffer import Buffer
from lapgs_wgpu.gpu.device import Device


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def on_device(device: Device, tensor: Tensor) -> Buffer:
    buffer = Buffer(device, 4 * tensor.numel(), "matrix")
    buffer.write(tensor.numpy())
    return buffer


def read(buffer: Buffer, *shape: int) -> Tensor:
    return torch.from_numpy(buffer.read("float32", shape))
