"""Matrices on the device."""

import torch
from torch import Tensor

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def on_device(device: Device, tensor: Tensor) -> DeviceArray:
    return DeviceArray.upload(device, "matrix", tensor.contiguous().numpy())


def read(array: DeviceArray) -> Tensor:
    return torch.from_numpy(array.read())
