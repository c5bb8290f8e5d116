"""Drawing and what is minimised in one go: the image and its gradient stay on the device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..gpu.buffer import Buffer, Request, read_all
from ..gpu.kernel import Commands
from .camera import Camera
from .gaussians import Gaussians
from .rasterize import read_requests, upload_gaussians
from .rasterizer import SPLAT_FLOATS, Rasterizer


class Recorded(NamedTuple):
    """terms: a buffer of `size` float32. d_image: (4, H, W) float32, the gradient by the image's planes, where it was
    asked for. d_correction: (rows, ...) float32, whose sum over the rows is the gradient by the correction."""

    terms: Buffer
    size: int
    d_image: Buffer | None
    d_correction: Request | None = None


# Records the passes that judge an image: (commands, image (4, H, W), whether its gradient is wanted).
Judge = Callable[[Commands, Buffer, bool], Recorded]


class Judged(NamedTuple):
    """loss: a scalar, differentiable in the Gaussians' tensors and in the correction. terms (count,) float32; radii and
    means2d as those of `Rendering`."""

    loss: Tensor
    terms: NDArray[np.float32]
    radii: Tensor
    means2d: Tensor


def judge_image(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    camera: Camera,
    background: tuple[float, float, float],
    judge: Judge,
    loss_of: Callable[[NDArray[np.float32]], float],
    correction: Tensor | None = None,
) -> Judged:
    """Draw the Gaussians, let `judge` compute terms of the image, and the loss, which `loss_of` makes of the terms.

    `judge`'s gradient must be that of the same loss. All passes, those of the gradient included, are submitted at once,
    and one read-back brings what the host needs; backward() multiplies the gradients that are then already there.
    correction: a tensor of `judge`'s own that the loss is differentiable in, too.
    Under torch.no_grad(), or where no tensor wants a gradient, none is computed.
    """
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    leaves = tensors if correction is None else (*tensors, correction)
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in leaves)
    probe = gaussians.means.new_zeros((len(gaussians), 2)).requires_grad_(wanted)
    task = _Task(rasterizer, gaussians.sh_degree, camera, background, judge, loss_of, wanted)
    loss, radii, centres = _Judge.apply(*tensors, correction, probe, task)
    with torch.no_grad():
        probe.copy_(centres)
    return Judged(loss, task.terms, radii, probe)


@dataclass
class _Task:
    """What `_Judge` needs besides tensors, and the terms that it leaves."""

    rasterizer: Rasterizer
    sh_degree: int
    camera: Camera
    background: tuple[float, float, float]
    judge: Judge
    loss_of: Callable[[NDArray[np.float32]], float]
    wanted: bool  # whether gradients are
    terms: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    def run(
        self, tensors: list[Tensor]
    ) -> tuple[NDArray[np.float32], list[NDArray[np.float32]], NDArray[np.float64] | None]:
        """Projected splats (N, 12); the gradients of the tensors and of means2d, none where none is wanted; and that
        of the correction, where there is one."""
        rasterizer, n = self.rasterizer, len(tensors[0])
        gaussians = upload_gaussians(rasterizer.pool, tensors, self.sh_degree)
        while True:
            image = rasterizer.draw(gaussians, self.camera, self.background)
            with Commands(rasterizer.device) as commands:
                recorded = self.judge(commands, image, self.wanted)
            requests = [
                (recorded.terms, "float32", (recorded.size,), 0),
                (rasterizer.pool.get("splats", 0), "float32", (n, SPLAT_FLOATS), 0),
            ]
            gradients = []
            if recorded.d_image is not None:
                gradients = read_requests(rasterizer.backward(recorded.d_image), n, tuple(tensors[4].shape))
            corrections = [recorded.d_correction] if recorded.d_correction is not None else []
            needed = rasterizer.needed_requests()
            arrays = read_all(requests + gradients + corrections + needed)
            # Where the intersections did not fit, none of this is right, and all of it is done again.
            if not rasterizer.fit(arrays[-len(needed) :]):
                self.terms = arrays[0]
                d_correction = arrays[2 + len(gradients)].sum(axis=0, dtype=np.float64) if corrections else None
                return arrays[1], arrays[2 : 2 + len(gradients)], d_correction


class _Judge(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        *tensors, correction, probe, task = arguments
        splats, gradients, d_correction = task.run(tensors)
        ctx.gradients = None
        if gradients:
            d_splats, d_means, d_quats, d_scales, d_sh = (torch.from_numpy(a).to(probe.device) for a in gradients)
            d_own = None if d_correction is None else correction.new_tensor(d_correction)
            ctx.gradients = (d_means, d_quats, d_scales, d_splats[:, 5], d_sh, d_own, d_splats[:, :2])
        projected = torch.from_numpy(splats).to(probe.device)
        radii, centres = projected[:, 10].to(torch.int32), projected[:, :2].contiguous()
        ctx.mark_non_differentiable(radii, centres)
        return probe.new_tensor(task.loss_of(task.terms)), radii, centres

    @staticmethod
    def backward(ctx: Any, *d_outputs: Any) -> tuple[Tensor | None, ...]:
        return (*(None if gradient is None else d_outputs[0] * gradient for gradient in ctx.gradients), None)
