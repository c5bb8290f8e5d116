"""Exposure: an affine correction of the colors for each training picture of a camera that does not keep its own.

A correction is a matrix (3, 4): corrected color = its first three columns times the color, plus its last one. It is
applied to the rendered image before the losses, and never to a view that is measured.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.optimizer import rate_at

MEAN_DECAY, SQUARE_DECAY = 0.9, 0.999  # Adam's
EPS = 1e-15  # keeps 0 / 0 away


def without_exposure(image: NDArray[np.float32], correction: NDArray[np.float32]) -> NDArray[np.float32]:
    """An image (H, W, 3) with its correction (3, 4) taken back: the colors that the scene has there."""
    return (image - correction[:, 3]) @ np.linalg.pinv(correction[:, :3]).T


def expose(
    commands: Commands,
    pool: BufferPool,
    image: DeviceArray,
    corrections: DeviceArray,
    first: Callable[[], int] = lambda: 0,
) -> DeviceArray:
    """Record the corrected image, in an array of the pool.

    image: planes (4, H, W) of float32, the first three red, green, blue. corrections: rows of four; `first` says which
    are the first of the image's three.
    """
    exposed = pool.array("exposed", image.shape)
    _dispatch(commands, pool, "exposure", first, image=image, corrections=corrections, exposed=exposed)
    return exposed


def expose_bwd(
    commands: Commands,
    pool: BufferPool,
    image: DeviceArray,
    d_exposed: DeviceArray,
    corrections: DeviceArray,
    first: Callable[[], int] = lambda: 0,
) -> tuple[DeviceArray, DeviceArray]:
    """Record the gradient by the rendered image's planes (4, H, W), and rows (H, 3, 4), whose sum is the correction's.

    d_exposed: the gradient by the corrected image; its fourth plane counts as zeros.
    """
    d_image, d_rows = pool.array("d_drawn", image.shape), pool.array("d_rows", (image.shape[1], 3, 4))
    arrays = {"image": image, "d_exposed": d_exposed, "corrections": corrections, "d_image": d_image, "d_rows": d_rows}
    _dispatch(commands, pool, "exposure_bwd", first, **arrays)
    return d_image, d_rows


def _dispatch(commands: Commands, pool: BufferPool, name: str, first: Callable[[], int], **arrays: DeviceArray) -> None:
    kernel = Kernel.get(pool.device, name, LANES=8 if pool.device.is_cpu else 64)
    _, height, width = arrays["image"].shape
    exposure = pool.varying("exposure", lambda: kernel.uniform("Exposure", size=(width, height), first=first()))
    commands.dispatch_grid(kernel, (1, height), exposure=exposure, **arrays)


class Exposures:
    """The corrections of all training pictures, (V, 3, 4), the identity at first, and how they learn.

    Adam, whose state of a picture stands still while that one has no gradient. Colors that all corrections share belong
    to the scene, which is measured without any: the mean of all stays the identity.
    """

    name = "exposure"

    def __init__(self, count: int, rate: Rate) -> None:
        self.rate = rate
        self.values = nn.Parameter(torch.eye(3, 4).repeat(count, 1, 1))
        self._mean, self._square = torch.zeros(2, count, 3, 4).unbind()
        self._steps = torch.zeros(count, 1, 1)

    @torch.no_grad()
    def step(self, step: int) -> None:
        """Move the corrections that have a gradient, at the rate of this step (counted from 1), and forget it."""
        if self.values.grad is None:
            return
        rows = self.values.grad.flatten(1).any(dim=1).nonzero()[:, 0]
        gradient = self.values.grad[rows]
        self._steps[rows] += 1
        self._mean[rows] = MEAN_DECAY * self._mean[rows] + (1 - MEAN_DECAY) * gradient
        self._square[rows] = SQUARE_DECAY * self._square[rows] + (1 - SQUARE_DECAY) * gradient.square()
        mean = self._mean[rows] / (1 - MEAN_DECAY ** self._steps[rows])
        size = (self._square[rows] / (1 - SQUARE_DECAY ** self._steps[rows])).sqrt()
        self.values[rows] -= rate_at(self.rate, step) * mean / (size + EPS)
        self.values.sub_(self.values.mean(dim=0) - torch.eye(3, 4))
        self.values.grad = None

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on, besides the gradient."""
        return {"values": self.values, "mean": self._mean, "square": self._square, "steps": self._steps}
