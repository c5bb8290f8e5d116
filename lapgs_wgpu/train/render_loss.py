"""A training step's picture and loss without either leaving the device, and the ground truth that waits there."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..gpu.buffer import Buffer
from ..gpu.device import Device
from ..gpu.kernel import Commands
from ..splat.camera import Camera
from ..splat.gaussians import Gaussians
from ..splat.objective import Recorded, judge_image
from ..splat.rasterize import rasterizer_of
from .exposure import ExposurePasses
from .image_loss import TERMS, ImageLoss
from .losses import LEAST_ERROR, LossWeights


class RenderLoss(NamedTuple):
    """loss: a scalar, differentiable in the Gaussians' tensors and in the correction. terms: l1, mse (mean squared
    error), ssim, pyramid and ncc (losses), as far as they were computed. radii (N,) and means2d (N, 2): as those of
    splat.rasterize.Rendering."""

    loss: Tensor
    terms: dict[str, float]
    radii: Tensor
    means2d: Tensor

    @property
    def psnr(self) -> float:
        """In dB over all pixels and channels, at most 100 dB."""
        return -10.0 * float(np.log10(max(self.terms["mse"], LEAST_ERROR)))


@functools.cache
def image_loss_of(device: Device) -> ImageLoss:
    """The losses that `render_loss` uses on this device; their buffers serve all calls."""
    return ImageLoss(device)


@functools.cache
def exposure_of(device: Device) -> ExposurePasses:
    """The passes of `render_loss`'s correction on this device."""
    return ExposurePasses(device)


def render_loss(
    gaussians: Gaussians,
    camera: Camera,
    truth: Buffer,
    background: Tensor,
    weights: LossWeights,
    device: Device,
    correction: Tensor | None = None,
) -> RenderLoss:
    """The loss of the Gaussians' image (train/losses.total), computed on the device from end to end.

    gaussians: activated, float32. truth: a picture as `upload_rgba` leaves it, of the
    camera's size. background: (3,) in [0, 1], under both; not differentiable. weights: of the terms.
    correction: (3, 4), of the image's colours before they are compared (train/exposure); none where None.
    The same bits on every run of one adapter and driver. Without a gradient to compute (torch.no_grad()) none is.
    """
    red, green, blue = background.tolist()
    size = (camera.height, camera.width)
    losses = image_loss_of(device)

    def judge(commands: Commands, image: Buffer, wanted: bool) -> Recorded:
        drawn, exposing = image, exposure_of(device)
        if correction is not None:
            image = exposing.record(commands, drawn, size, correction)
        done = losses.record(commands, image, truth, size, (red, green, blue), weights, gradient=wanted)
        if correction is None or done.d_image is None:
            return Recorded(done.terms, TERMS, done.d_image)
        exposed = exposing.record_bwd(commands, drawn, done.d_image, size, correction)
        return Recorded(done.terms, TERMS, exposed.d_image, (exposed.d_rows, "float32", (size[0], 3, 4), 0))

    def loss_of(terms: NDArray[np.float32]) -> float:
        return float(np.dot(terms.astype(np.float64), [weights.l1, 0, weights.ssim, weights.pyramid, weights.ncc]))

    judged = judge_image(rasterizer_of(device), gaussians, camera, (red, green, blue), judge, loss_of, correction)
    names = ("l1", "mse", "ssim", "pyramid", "ncc")
    used = (True, True, weights.ssim, weights.pyramid, weights.ncc)
    terms = {name: value for name, value, use in zip(names, judged.terms.tolist(), used, strict=True) if use}
    if "ssim" in terms:
        terms["ssim"] = 1.0 - terms["ssim"]
    return RenderLoss(judged.loss, terms, judged.radii, judged.means2d)


class TruthCache:
    """Pictures on the device in 8 bits, the most recently used first to stay, within a bound in bytes.

    max_bytes: bound on what is kept, 4 bytes a pixel; a picture larger than this is handed out and not kept.
    """

    def __init__(self, device: Device, max_bytes: int) -> None:
        self.device, self.max_bytes = device, max_bytes
        self._held: OrderedDict[Hashable, Buffer] = OrderedDict()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._held

    @property
    def used_bytes(self) -> int:
        """Bytes kept at present."""
        return sum(buffer.nbytes for buffer in self._held.values())

    def clear(self) -> None:
        """Keep none of them any more."""
        self._held.clear()

    def get(self, key: Hashable, load: Callable[[], NDArray[np.uint8]]) -> Buffer:
        """The picture of this key; `load` is called where it is not held: (H, W, 3) RGB or (H, W, 4) straight RGBA."""
        buffer = self._held.pop(key, None) or upload_rgba(self.device, load())
        if buffer.nbytes <= self.max_bytes:
            while self.used_bytes + buffer.nbytes > self.max_bytes:
                self._held.popitem(last=False)
            self._held[key] = buffer
        return buffer


def upload_rgba(device: Device, pixels: NDArray[np.uint8]) -> Buffer:
    """(H, W) u32 on the device, red in the lowest byte, of (H, W, 3) RGB or (H, W, 4) straight RGBA in 8 bits."""
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., : pixels.shape[2]] = pixels
    buffer = Buffer(device, rgba.nbytes, "truth")
    buffer.write(rgba)
    return buffer
