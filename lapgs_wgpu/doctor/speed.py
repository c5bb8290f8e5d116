"""Speeds of the passes that a training spends its time in, for comparing machines. `make bench` measures in detail."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.hash_encoder import HashEncoder, HashGrid
from lapgs_wgpu.motion.fields.hash_grid_config import TIME, HashConfig
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.splat.rasterize import rasterize

_GAUSSIANS, _SIZE = 10_000, 256
_COPIED = 32 << 20  # bytes
_MOST_RUNS = 20  # that are timed, after one that compiles


class Speed(NamedTuple):
    """make: sets up, and returns what is timed, which waits for the device. unit: "ms" for the time of a run; otherwise
    a rate, of which a run does `amount` times a second."""

    name: str
    make: Callable[[Device], Callable[[], object]]
    unit: str
    amount: float = 1.0


def measure(speed: Speed, device: Device, seconds: float) -> float:
    """The median in the speed's unit, of at least one run and as many as fit into `seconds`."""
    end = time.perf_counter() + seconds
    run = speed.make(device)
    run()
    times = list[float]()
    while not times or (time.perf_counter() < end and len(times) < _MOST_RUNS):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    median = statistics.median(times)
    return 1e3 * median if speed.unit == "ms" else speed.amount / median


def _copy(device: Device) -> Callable[[], object]:
    values = np.zeros(_COPIED // 4, np.float32)
    array = DeviceArray.upload(device, "copied", values)

    def copy() -> None:
        array.write(values)
        array.read()

    return copy


def _tensors() -> tuple[list[torch.Tensor], Camera]:
    """A ball of Gaussians as in `make bench`, but fewer, and a camera that sees all of it."""
    random = torch.Generator().manual_seed(0)
    means = torch.randn(_GAUSSIANS, 3, generator=random)
    means *= 1.3 * torch.rand(_GAUSSIANS, 1, generator=random) ** (1 / 3) / means.norm(dim=1, keepdim=True)
    means = means[morton_order(means)]
    quats = torch.randn(_GAUSSIANS, 4, generator=random)
    scales = torch.full((_GAUSSIANS, 3), 0.034)
    opacities = torch.rand(_GAUSSIANS, generator=random) * 0.9 + 0.05
    colors = torch.rand(_GAUSSIANS, 3, generator=random)
    camera = Camera.looking_at([0, 0, -4], [0, 0, 0], up=[0, -1, 0], fov_x=0.69, width=_SIZE, height=_SIZE)
    return [means, quats, scales, opacities, colors], camera


def _draw(tensors: list[torch.Tensor], camera: Camera, device: Device) -> torch.Tensor:
    means, quats, scales, opacities, colors = tensors
    return rasterize(means, quats, scales, opacities, colors, camera, depth=False, device=device).image


def _forward(device: Device) -> Callable[[], object]:
    tensors, camera = _tensors()
    return lambda: _draw(tensors, camera, device)


def _forward_backward(device: Device) -> Callable[[], object]:
    tensors, camera = _tensors()
    for tensor in tensors:
        tensor.requires_grad_()
    return lambda: _draw(tensors, camera, device).mean().backward()


def _hash_encoder(device: Device) -> Callable[[], object]:
    """Grids of a size between those of the presets tiny and dnerf."""
    config = HashConfig(levels=8, base=(16, 16, 16), finest=(256, 256, 32), table_log2=15)
    grids = [
        HashGrid(config, axes, torch.Generator()) for axes in ((0, 1, 2), (0, 1, TIME), (1, 2, TIME), (0, 2, TIME))
    ]
    encoder, points = HashEncoder(device, [grids], bound=1.3), _tensors()[0][0]
    return lambda: encoder(points, 0.3)[0].mean().backward()


def _torch_matmul(_: Device) -> Callable[[], object]:
    a, b = torch.rand(_GAUSSIANS, 128), torch.rand(128, 128)
    return lambda: a @ b


_SCENE = f"{_GAUSSIANS:,} Gaussians, {_SIZE}x{_SIZE}"
SPEEDS = (
    Speed("copy to the device and back", _copy, "GB/s", 2 * _COPIED / 1e9),
    Speed(f"forward, {_SCENE}", _forward, "ms"),
    Speed(f"forward and backward, {_SCENE}", _forward_backward, "ms"),
    Speed(f"hash encoder, forward and backward, {_GAUSSIANS:,} points, 32 levels", _hash_encoder, "ms"),
    Speed("torch: matrix product on the processor", _torch_matmul, "GFLOP/s", 2 * _GAUSSIANS * 128 * 128 / 1e9),
)
