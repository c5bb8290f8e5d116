"""`rasterize`: the differentiable door to the rasteriser for torch tensors."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ..gpu.buffer import Buffer, BufferPool, Request, read_all
from ..gpu.device import Device, open_device
from .camera import Camera
from .rasterizer import SPLAT_FLOATS, GaussianBuffers, GradientBuffers, Rasterizer


class Rendering(NamedTuple):
    """image (H, W, 3); alpha (H, W); depth (H, W): sum of weight times camera depth, not divided by alpha;
    radii (N,) int32 in pixels, 0 where a Gaussian is not seen; means2d (N, 2) in pixels, whose .grad holds, after
    backward(), the loss's gradient by them (what density control needs)."""

    image: Tensor
    alpha: Tensor
    depth: Tensor
    radii: Tensor
    means2d: Tensor


class Seen(Protocol):
    """What density control needs of a `Rendering`."""

    @property
    def radii(self) -> Tensor: ...
    @property
    def means2d(self) -> Tensor: ...


@functools.cache
def rasterizer_of(device: Device) -> Rasterizer:
    """The rasteriser that `rasterize` uses on this device; its buffers serve all calls."""
    return Rasterizer(device)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    depth: bool = True,
    device: Device | None = None,
) -> Rendering:
    """Draw N Gaussians. Differentiable in all tensors. Argument names follow gsplat.

    means (N, 3) world units; quats (N, 4) wxyz of any length; scales (N, 3) standard deviations; opacities (N,) in
    [0, 1]; colors (N, 3), or (N, K, 3) spherical harmonics when sh_degree (0 to 3, (sh_degree + 1)^2 <= K) is given;
    background (3,), black where None. All activated, float32, on any torch device; the result is on means' device.
    depth: whether to draw it; without, its picture is zero and a tenth of the time is saved.
    device: a lapgs_wgpu Device, the default adapter where None.

    The gradient is the same to the last bit on every run of one adapter and driver.
    Raises ValueError where shapes disagree.
    """
    n = means.shape[0]
    expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, tensor in (("means", means), ("quats", quats), ("scales", scales), ("opacities", opacities)):
        if tuple(tensor.shape) != expected[name]:
            raise ValueError(f"rasterize: {name} must have shape {expected[name]}, got {tuple(tensor.shape)}")
    if sh_degree is None:
        if tuple(colors.shape) != (n, 3):
            raise ValueError(f"rasterize: colors must have shape {(n, 3)} without sh_degree, got {tuple(colors.shape)}")
    elif not 0 <= sh_degree <= 3:
        raise ValueError(f"rasterize: sh_degree must be 0 to 3, got {sh_degree}")
    elif colors.ndim != 3 or colors.shape[0] != n or colors.shape[2] != 3 or colors.shape[1] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"rasterize: colors must have shape ({n}, K >= {(sh_degree + 1) ** 2}, 3) for sh_degree {sh_degree}, "
            f"got {tuple(colors.shape)}"
        )
    if background is None:
        background = means.new_zeros(3)
    elif tuple(background.shape) != (3,):
        raise ValueError(f"rasterize: background must have shape (3,), got {tuple(background.shape)}")
    probe = means.new_zeros((n, 2)).requires_grad_(torch.is_grad_enabled())
    image, alpha, z, radii, centres = _Rasterize.apply(
        means, quats, scales, opacities, colors, background, probe, camera, sh_degree, depth, device or open_device()
    )
    with torch.no_grad():
        probe.copy_(centres)
    return Rendering(image, alpha, z, radii, probe)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, probe, camera, sh_degree, depth, device = arguments
        rasterizer = rasterizer_of(device)
        n, height, width = len(probe), camera.height, camera.width
        ctx.camera, ctx.sh_degree, ctx.depth, ctx.rasterizer = camera, sh_degree, depth, rasterizer
        if n == 0:
            background = tensors[5]
            ctx.save_for_backward(*tensors, background.new_ones((height, width)))
            ctx.drawing = None
            image = background.expand(height, width, 3).clone()
            empty = image.new_zeros((height, width))
            radii = torch.zeros(0, dtype=torch.int32, device=image.device)
            ctx.mark_non_differentiable(radii)
            return image, empty, empty.clone(), radii, probe.detach().clone()
        planes, splats = _draw(rasterizer, tensors, camera, sh_degree, depth)
        ctx.drawing = rasterizer._drawn
        out = torch.from_numpy(planes).to(probe.device)
        projected = torch.from_numpy(splats).to(probe.device)
        ctx.save_for_backward(*tensors, out[3])
        z = out[4].clone() if depth else torch.zeros_like(out[3])
        radii = projected[:, 10].to(torch.int32)
        ctx.mark_non_differentiable(radii)
        centres = projected[:, :2].contiguous()
        ctx.mark_non_differentiable(centres)
        return out[:3].permute(1, 2, 0).contiguous(), 1.0 - out[3], z, radii, centres

    @staticmethod
    def backward(ctx: Any, *d_outputs: Any) -> tuple[Tensor | None, ...]:
        d_image, d_alpha, d_depth = d_outputs[:3]
        *tensors, transmittance = ctx.saved_tensors
        background = tensors[5]
        d_background = (d_image * transmittance[..., None]).sum((0, 1)) if ctx.needs_input_grad[5] else None
        if ctx.drawing is None:
            empty = [torch.zeros_like(t) for t in tensors[:5]]
            return (*empty, d_background, background.new_zeros((0, 2)), *[None] * 4)
        rasterizer: Rasterizer = ctx.rasterizer
        if rasterizer._drawn is not ctx.drawing:  # another image was drawn in between: its buffers are not ours
            _draw(rasterizer, tensors, ctx.camera, ctx.sh_degree, ctx.depth)
            ctx.drawing = rasterizer._drawn
        planes = torch.cat([d_image.permute(2, 0, 1), d_alpha[None], *([d_depth[None]] if ctx.depth else [])])
        d_planes = _upload(rasterizer.pool, "d_image", planes)
        gradients = rasterizer.backward(d_planes)
        n = len(tensors[0])
        requests = read_requests(gradients, n, tuple(tensors[4].shape))
        d_splats, d_means, d_quats, d_scales, *d_sh = (
            torch.from_numpy(array).to(background.device) for array in read_all(requests)
        )
        d_colors = d_sh[0] if d_sh else d_splats[:, 6:9]
        return (
            d_means, d_quats, d_scales, d_splats[:, 5], d_colors, d_background, d_splats[:, :2], *[None] * 4
        )  # fmt: skip


def _draw(
    rasterizer: Rasterizer, tensors: list[Tensor], camera: Camera, sh_degree: int | None, depth: bool
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Upload, draw until the buffers are large enough, read back: planes (4 or 5, H, W) and splats (N, 12)."""
    *shapes, background = tensors
    n = len(shapes[0])
    gaussians = upload_gaussians(rasterizer.pool, shapes, sh_degree)
    red, green, blue = background.tolist()
    while True:
        image = rasterizer.draw(gaussians, camera, (red, green, blue), depth=depth)
        splats = rasterizer.pool.get("splats", 0)
        planes, projected, *needed = read_all(
            [
                (image, "float32", (5 if depth else 4, camera.height, camera.width), 0),
                (splats, "float32", (n, SPLAT_FLOATS), 0),
                *rasterizer.needed_requests(),
            ]
        )
        if not rasterizer.fit(needed):
            return planes, projected


def upload_gaussians(pool: BufferPool, tensors: list[Tensor], sh_degree: int | None) -> GaussianBuffers:
    """The tensors means, quats, scales, opacities and colors, in buffers of a pool."""
    names = ("means", "quats", "scales", "opacities", "colors")
    buffers = {name: _upload(pool, name, tensor) for name, tensor in zip(names, tensors, strict=True)}
    stored = 1 if sh_degree is None else tensors[4].shape[1]
    return GaussianBuffers(count=len(tensors[0]), sh_degree=sh_degree, sh_stored=stored, **buffers)


def read_requests(gradients: GradientBuffers, n: int, colors: tuple[int, ...]) -> list[Request]:
    """What to read (with `read_all`) to have gradients: splats, means, quats, scales, and colours where they are
    spherical harmonics, which have this shape."""
    requests: list[Request] = [
        (gradients.splats, "float32", (n, SPLAT_FLOATS), 0),
        (gradients.means, "float32", (n, 3), 0),
        (gradients.quats, "float32", (n, 4), 0),
        (gradients.scales, "float32", (n, 3), 0),
    ]
    if gradients.colors is not None:
        requests.append((gradients.colors, "float32", colors, 0))
    return requests


def _upload(pool: BufferPool, name: str, tensor: Tensor) -> Buffer:
    array = tensor.detach().to("cpu", torch.float32).contiguous().numpy()
    buffer = pool.get(f"input {name}", array.nbytes)
    buffer.write(array)
    return buffer
