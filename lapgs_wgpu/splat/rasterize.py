"""`rasterize`: the rasterizer as a differentiable function of torch tensors."""

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import COLOR, CONSTANTS, MEAN, OPACITY, RADIUS
from lapgs_wgpu.splat.drawing import camera_gradient
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer


class Rendering(NamedTuple):
    """A rendered image and the projected Gaussians.

    Attributes:
        image: (H, W, 3).
        alpha: (H, W).
        depth: (H, W) sum of weight times camera depth, not divided by alpha.
        radii: (N,) int32 in pixels, 0 for invisible Gaussians.
        means2d: (N, 2) in pixels; after backward(), its .grad is the gradient of the loss, which density control needs.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    radii: Tensor
    means2d: Tensor


# The rasterizer of a device, whose buffers serve all calls of `rasterize`.
rasterizer_of = functools.cache(Rasterizer)


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
    antialiased: bool | float = False,
    depth: bool = True,
    device: Device | None = None,
) -> Rendering:
    """Render N Gaussians. Differentiable in all tensors. Argument names follow gsplat.

    Args:
        means: (N, 3) world units. All tensors are float32, activated, on any torch device.
        quats: (N, 4) wxyz, of any length.
        scales: (N, 3) standard deviations, world units.
        opacities: (N,) in [0, 1].
        colors: (N, 3); with sh_degree: (N, K, 3) spherical harmonics, K >= (sh_degree + 1)^2.
        sh_degree: 0 to 3.
        background: (3,); None for black.
        camera: which renders the image.
        antialiased: whether a Gaussian is drawn as much fainter as the low-pass filter makes it larger in the image, as
            gsplat's rasterize_mode "antialiased"; a number is the filter's variance, px², otherwise 0.3.
        depth: whether to render depth, which takes a tenth of the time; otherwise it is zero.
        device: None for the default adapter.

    Returns:
        Rendering, on the device of `means`. Image and gradients are the same to the last bit on every run with one
        adapter and driver.

    Raises:
        ValueError: shapes do not match, or the variance is negative.
    """
    if not antialiased >= 0:
        raise ValueError(f"rasterize: antialiased must be True, False or a variance above 0, px², got {antialiased}")
    check_shapes("rasterize", means, quats, scales, opacities, colors, sh_degree)
    background = means.new_zeros(3) if background is None else background
    if tuple(background.shape) != (3,):
        raise ValueError(f"rasterize: background must have shape (3,), got {tuple(background.shape)}")
    sh = colors if sh_degree is None else colors[:, : (sh_degree + 1) ** 2]
    probe = means.new_empty((len(means), 2)).requires_grad_(torch.is_grad_enabled())
    image, alpha, z, splats = Rasterize.apply(
        means, quats, scales, opacities, sh, background, probe, None, camera, antialiased, depth, device
    )
    radii, probe.data = radii_and_centres(splats.numpy(), means.device)
    return Rendering(image, alpha, z, radii, probe)


def check_shapes(
    caller: str, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, sh_degree: int | None
) -> None:
    """Raise ValueError, in the name of `caller`, unless the tensors have the shapes that `rasterize` lists."""
    if sh_degree is not None and not 0 <= sh_degree <= 3:
        raise ValueError(f"{caller}: sh_degree must be 0 to 3, got {sh_degree}")
    n, least = len(means), None if sh_degree is None else (sh_degree + 1) ** 2
    used = colors[:, :least] if colors.ndim == 3 else colors
    expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    expected["colors"] = (n, 3) if least is None else (n, least, 3)
    for (name, shape), tensor in zip(expected.items(), (means, quats, scales, opacities, used), strict=True):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{caller}: {name} must have shape {shape}, got {tuple(tensor.shape)}")


class Rasterize(torch.autograd.Function):
    """The drawing of `rasterize`.

    apply(means, quats, scales, opacities, sh, background, probe, viewmat, camera, antialiased, depth, device): probe
    (N, 2) takes the gradient by the projected means, viewmat (4, 4), where not None, that of `camera` by rigid changes.
    Returns image, alpha, depth, and the projected Gaussians (N, SPLAT_FLOATS), on the host and without a gradient.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, background, probe, _, camera, antialiased, depth, device = arguments
        rasterizer = ctx.rasterizer = rasterizer_of(device or open_device())
        gaussians = upload_gaussians(rasterizer.pool, Gaussians(*tensors, antialiased=antialiased))
        red, green, blue = background.tolist()
        how = {"depth": depth, "gradient": probe.requires_grad}
        while True:
            ctx.drawing = drawing = rasterizer.draw(gaussians, camera, (red, green, blue), **how)
            planes, splats, *needed = read_all([drawing.image, drawing.splats, *drawing.needed])
            if not rasterizer.grow_on_overflow(drawing, needed):
                break
        # By numpy: each operator of torch of this size wakes its threads, and they and the driver's take turns. By
        # planes: three times as fast as a transposed copy.
        rgb, z = np.stack(list(planes[:3]), axis=-1), planes[4].copy() if depth else np.zeros_like(planes[3])
        image, alpha, z = (torch.from_numpy(array).to(probe.device) for array in (rgb, 1 - planes[3], z))
        ctx.save_for_backward(*tensors, background, torch.from_numpy(planes[3]).to(probe.device))
        ctx.set_materialize_grads(False)
        projected = torch.from_numpy(splats)
        ctx.mark_non_differentiable(projected)
        return image, alpha, z, projected

    @staticmethod
    def backward(ctx: Any, *d_outputs: Any) -> tuple[Tensor | None, ...]:
        d_image, d_alpha, d_depth = d_outputs[:3]
        *tensors, background, transmittance = ctx.saved_tensors
        d_background = torch.zeros_like(background) if ctx.needs_input_grad[5] else None
        if d_background is not None and d_image is not None:
            d_background += (d_image * transmittance[..., None]).sum((0, 1))
        rasterizer, drawing = ctx.rasterizer, ctx.drawing
        if not rasterizer.holds(drawing):  # another image was drawn in between
            gaussians = Gaussians(*tensors, antialiased=drawing.gaussians.antialiased)
            given = upload_gaussians(rasterizer.pool, gaussians), drawing.camera, drawing.background
            ctx.drawing = drawing = rasterizer.draw_whole(*given, depth=drawing.depth, gradient=True)
        planes = np.zeros((5 if drawing.depth else 4, *transmittance.shape), np.float32)
        if d_image is not None:
            planes[:3] = d_image.numpy(force=True).transpose(2, 0, 1)
        if d_alpha is not None:
            planes[3] = d_alpha.numpy(force=True)
        if drawing.depth and d_depth is not None:
            planes[4] = d_depth.numpy(force=True)
        d_planes = rasterizer.pool.upload("d_image", planes)
        gradients = rasterizer.backward(drawing, d_planes, camera=ctx.needs_input_grad[7])
        d_viewmat = None
        if gradients.camera is not None:
            d_viewmat = _viewmat_gradient(gradients.camera.read(), drawing.camera).to(background)
        by_gaussians, d_means2d = gradient_tensors(read_all(gradients.arrays()), tensors[3])
        return (*by_gaussians, d_background, d_means2d, d_viewmat, *[None] * 4)


def _viewmat_gradient(sums: NDArray[np.float32], camera: Camera) -> Tensor:
    """Gradient (4, 4) by the matrix from world to camera, the part of it along rigid changes.

    A turn by the vector v about the world's axes changes R by R [v] and t by -R (v x center), a shift of the center by
    s changes t by -R s; [v] is the matrix of the cross product. sums: GaussianGradients.camera, read back.
    """
    turn, shift = (-part for part in camera_gradient(sums))  # of all Gaussians instead of the camera
    x, y, z = turn + np.cross(camera.position, shift)
    R, gradient = camera.T_cam_world[:3, :3], np.zeros((4, 4))
    gradient[:3, :3] = R @ (0.5 * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    gradient[:3, 3] = R @ shift
    return torch.from_numpy(gradient)


def upload_gaussians(pool: BufferPool, gaussians: Gaussians[Tensor]) -> Gaussians[DeviceArray]:
    """Upload Gaussians to buffers of a pool."""
    arrays = {name: upload(pool, name, tensor) for name, tensor in gaussians.arrays().items()}
    return Gaussians(**arrays, antialiased=gaussians.antialiased)


def radii_and_centres(splats: NDArray[np.float32], device: torch.device) -> tuple[Tensor, Tensor]:
    """`radii` and `means2d` of a Rendering, from splats (N, SPLAT_FLOATS) that were read back."""
    largest = np.float32(np.iinfo(np.int32).max - 127)  # the nearest float32 below
    radii, centres = np.minimum(splats[:, RADIUS], largest).astype(np.int32), splats[:, MEAN].copy()
    return torch.from_numpy(radii).to(device), torch.from_numpy(centres).to(device)


def gradient_tensors(arrays: list[NDArray[np.float32]], opacities: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    """Return gradients of means, quats, scales, opacities and sh, and of means2d, on the opacities' torch device.

    arrays: GaussianGradients, read back.
    """
    d_splats, d_means, d_quats, d_scales, *d_sh = (torch.from_numpy(array).to(opacities.device) for array in arrays)
    drawn = opacities >= CONSTANTS["ALPHA_MIN"]  # false where it is NaN
    d_opacities = torch.where(drawn, d_splats[:, OPACITY] / opacities, 0.0)
    d_colors = d_sh[0] if d_sh else d_splats[:, COLOR]
    return (d_means, d_quats, d_scales, d_opacities, d_colors), d_splats[:, MEAN]


def upload(pool: BufferPool, name: str, tensor: Tensor) -> DeviceArray:
    """Return a copy of a tensor, as float32, in the buffer `input NAME` of a pool."""
    return pool.upload(f"input {name}", np.ascontiguousarray(tensor.detach().to("cpu", torch.float32).numpy()))
