"""What each Gaussian contributes to the training images, by which density control prunes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterize


def contributions(scene: Scene4D, views: Sequence[View], *, moving: bool) -> Tensor:
    """(N,) sum of the blending weights of a Gaussian over the pixels of a view, the largest over the views.

    In pixels: 1 is one pixel that shows nothing else. moving: whether the field moves the Gaussians; otherwise each
    view shows the canonical ones. The same bits on every run of one adapter and driver.
    """
    most = torch.zeros(len(scene), device=scene.parameters["means"].device)
    for view in views:
        with torch.no_grad():
            gaussians = scene.at(view.time) if moving else scene.canonical()
        most = torch.maximum(most, _blending_weights(gaussians, view, scene))
    return most


def _blending_weights(gaussians: Gaussians[Tensor], view: View, scene: Scene4D) -> Tensor:
    """(N,) their sums over the pixels of a view: the gradient of the sum of the image by the colors."""
    colors = torch.zeros_like(gaussians.means, requires_grad=True)
    shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    rendering = rasterize(
        *shape, colors, view.camera, antialiased=gaussians.antialiased, depth=False, device=scene.device
    )
    (gradient,) = torch.autograd.grad(rendering.image[..., 0].sum(), colors)
    return gradient[:, 0]
