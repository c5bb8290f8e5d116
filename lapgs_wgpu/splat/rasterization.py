"""`rasterization`: gsplat's call, with its arguments and its dictionary, drawn by `rasterize`."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONIC, CONSTANTS, DEPTH, MEAN, OPACITY, RADIUS
from lapgs_wgpu.splat.rasterize import Rasterize, check_shapes

_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians with C cameras, as gsplat's function of this name (version 1.6); its defaults.

    Differentiable in all tensors but Ks; in viewmats along rigid changes, so a pose made of a rotation and a shift
    learns as with gsplat.

    Args:
        means: (N, 3) world units. All tensors are float32, on any torch device.
        quats: (N, 4) wxyz, of any length.
        scales: (N, 3) standard deviations, world units.
        opacities: (N,) in [0, 1].
        colors: (N, 3) or (C, N, 3); with sh_degree (N, K, 3) or (C, N, K, 3). None where only depth is rendered.
        viewmats: (C, 4, 4) from world to camera, OpenCV axes.
        Ks: (C, 3, 3) intrinsics, pixels.
        width: of the images, pixels.
        height: of the images, pixels.
        near_plane: depth from which Gaussians are drawn, world units; 0.01 at least.
        far_plane: depth up to which they are.
        radius_clip: 0 alone is supported.
        eps2d: 0.3 alone is supported.
        sh_degree: of the harmonics in colors; None for colors.
        packed: how the dictionary lists projected Gaussians: rows of visible ones only, or all of every camera.
        tile_size: changes no result.
        backgrounds: (C, 3).
        render_mode: one of RGB, D (sum of weight times depth), ED (D divided by alpha), RGB+D, RGB+ED.
        sparse_grad: not supported.
        absgrad: not supported.
        rasterize_mode: classic or antialiased.
        channel_chunk: changes no result.
        distributed: not supported.
        camera_model: pinhole alone is supported.
        segmented: changes no result.
        covars: not supported.
        others: further arguments of gsplat's; their defaults alone are supported.

    Returns:
        Colors (C, height, width, X), alphas (C, height, width, 1), and a dictionary: batch_ids, camera_ids and
        gaussian_ids (of the rows, None if not packed), radii (..., 2) int32, the larger one twice, means2d (..., 2),
        depths, conics (..., 3), opacities as drawn, width, height, n_batches, n_cameras. Of these only means2d has a
        gradient, which `loss.backward()` leaves in its .grad. gsplat's lists of tiles are not in it.

    Raises:
        NotImplementedError: an argument asks for what is not supported.
        ValueError: shapes do not match.
    """
    zeros = {"radius_clip": radius_clip, "sparse_grad": sparse_grad, "absgrad": absgrad, "distributed": distributed}
    others |= zeros | {"covars": covars, "eps2d": eps2d - CONSTANTS["DILATION"]}
    others["global_z_order"] = not others.get("global_z_order", True)
    for name, value in others.items():
        if isinstance(value, Tensor) or value:
            raise NotImplementedError(f"rasterization: {name} is not supported but by gsplat's default")
    modes = {"render_mode": (render_mode, _MODES), "rasterize_mode": (rasterize_mode, ("classic", "antialiased"))}
    for name, (value, known) in (modes | {"camera_model": (camera_model, ("pinhole",))}).items():
        if value not in known:
            raise NotImplementedError(f"rasterization: {name} {value!r} is not one of {', '.join(known)}")
    if near_plane < CONSTANTS["NEAR"] or means.ndim != 2:
        raise NotImplementedError("rasterization: near_plane below 0.01 and batches of scenes are not supported")
    count, views = len(means), len(viewmats)
    colors = means.new_zeros(count, 3) if colors is None else colors
    of_view = colors.ndim == (3 if sh_degree is None else 4)  # each camera sees its own
    check_shapes("rasterization", means, quats, scales, opacities, colors[0] if of_view else colors, sh_degree)
    for name, tensor, shape in (("viewmats", viewmats, (views, 4, 4)), ("Ks", Ks, (views, 3, 3))):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"rasterization: {name} must have shape {shape}, got {tuple(tensor.shape)}")
    used = slice(None) if sh_degree is None else slice((sh_degree + 1) ** 2)
    full = means.new_zeros(views, count, 2).requires_grad_(torch.is_grad_enabled())
    depth, images, alphas, splats = render_mode != "RGB", [], [], []
    for c, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        T = viewmat.detach().cpu().double().numpy()
        camera = Camera(K.detach().cpu().double().numpy(), T, width, height, near_plane)
        far = means.detach() @ viewmat[2, :3].detach().to(means) + T[2, 3] > far_plane
        background = means.new_zeros(3) if backgrounds is None else backgrounds[c]
        rgb, alpha, z, projected = Rasterize.apply(
            means, quats, scales, torch.where(far, 0.0, opacities), (colors[c] if of_view else colors)[:, used],
            background, full[c], viewmat, camera, rasterize_mode == "antialiased", depth, None,
        )  # fmt: skip
        if render_mode.endswith("ED"):
            z = z / alpha.clamp(min=1e-10)
        parts = ([rgb] if "RGB" in render_mode else []) + ([z[..., None]] if depth else [])
        images.append(torch.cat(parts, dim=-1))
        alphas.append(alpha[..., None])
        splats.append(projected)
    meta = _meta(torch.stack(splats).to(means.device), full, packed)
    meta |= {"width": width, "height": height, "n_batches": 1, "n_cameras": views}
    return torch.stack(images), torch.stack(alphas), meta


def _meta(splats: Tensor, full: Tensor, packed: bool) -> dict[str, Any]:
    """What gsplat's dictionary says of projected Gaussians. splats: (C, N, SPLAT_FLOATS). full: (C, N, 2), which
    `backward()` gives the gradient by the projected means."""
    ids: list[Tensor | None] = [None, None, None]
    visible = splats[..., RADIUS] > 0
    full.data = splats[..., MEAN].clone()
    means2d = full
    if packed:
        cameras, gaussians = visible.nonzero(as_tuple=True)
        ids = [torch.zeros_like(cameras), cameras, gaussians]
        splats, visible = splats[cameras, gaussians], visible[cameras, gaussians]
        means2d = splats[..., MEAN].clone().requires_grad_(full.requires_grad)
        if full.requires_grad:

            def keep(gradient: Tensor) -> None:
                rows = gradient[cameras, gaussians]
                means2d.grad = rows if means2d.grad is None else means2d.grad + rows

            full.register_hook(keep)
    radii = splats[..., RADIUS].clamp(max=float(np.iinfo(np.int32).max - 127)).int()
    return dict(zip(("batch_ids", "camera_ids", "gaussian_ids"), ids, strict=True)) | {
        "radii": torch.stack([radii, radii], dim=-1),
        "means2d": means2d,
        "depths": splats[..., DEPTH].clone(),
        "conics": splats[..., CONIC].clone(),
        "opacities": torch.where(visible, splats[..., OPACITY].exp2(), 0.0),
    }
