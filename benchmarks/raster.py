"""The rasterizer: each pass by the device's own clock, the whole from outside."""

import dataclasses
from typing import Any

import numpy as np
import torch
from measure import Timing, Traffic, timed, traffic
from numpy.typing import NDArray
from passes import Meter, PassTimes
from work import SceneCounts, count_scene, raster_work

from lapgs_wgpu import Camera, rasterize
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.drawing import Drawing
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer

NAMES = ("means", "quats", "scales", "opacities", "colors")


@dataclasses.dataclass(frozen=True)
class RasterReport:
    """forward, forward_backward: with everything on the device, until it is done. torch_...: the same through
    `rasterize` and autograd, every input and output exchanged with torch."""

    counts: SceneCounts
    shape: dict[str, Any]
    passes: PassTimes | None
    forward: Timing
    forward_backward: Timing
    torch_forward: Timing
    torch_forward_backward: Timing
    torch_traffic: Traffic


def bench_raster(
    device: Device,
    arrays: dict[str, NDArray[np.float32]],
    camera: Camera,
    meter: Meter | None,
    repeat: int,
) -> RasterReport:
    """Time the scene on the device. The gradient of the image is random, of unit variance."""
    rasterizer = Rasterizer(device)
    gaussians = Gaussians(*(DeviceArray.upload(device, name, arrays[name]) for name in NAMES))
    rng = np.random.default_rng(1)
    gradient = rng.standard_normal((4, camera.height, camera.width), np.float32)
    d_image = DeviceArray.upload(device, "d_image", gradient)

    def forward() -> Drawing:
        return rasterizer.draw_whole(gaussians, camera)

    def forward_backward() -> None:
        drawing = rasterizer.draw(gaussians, camera)
        rasterizer.backward(drawing, d_image)
        rasterizer.grow_on_overflow(drawing)

    forward()
    whole = timed(forward, repeat), timed(forward_backward, repeat)
    counts = count_scene(rasterizer, forward())

    def submit() -> None:
        rasterizer.backward(rasterizer.draw(gaussians, camera), d_image)

    passes = meter(submit, raster_work(counts, rasterizer), repeat) if meter else None

    inputs = [torch.from_numpy(arrays[name]).requires_grad_() for name in NAMES]
    d_rgb = torch.from_numpy(gradient[:3]).permute(1, 2, 0).contiguous()

    def torch_draw() -> torch.Tensor:
        means, quats, scales, opacities, colors = inputs
        return rasterize(means, quats, scales, opacities, colors, camera, device=device).image

    def torch_forward() -> None:
        with torch.no_grad():
            torch_draw()

    def torch_forward_backward() -> None:
        torch.autograd.grad(torch_draw(), inputs, d_rgb)

    torch_whole = timed(torch_forward, repeat), timed(torch_forward_backward, repeat)
    return RasterReport(
        counts,
        dataclasses.asdict(rasterizer.config),
        passes,
        forward=whole[0],
        forward_backward=whole[1],
        torch_forward=torch_whole[0],
        torch_forward_backward=torch_whole[1],
        torch_traffic=traffic(torch_forward_backward),
    )
