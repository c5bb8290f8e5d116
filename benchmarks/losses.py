"""All image losses and their gradient, against their torch references in the same run."""

from dataclasses import dataclass

import numpy as np
import torch
from helpers.loss_reference import total
from measure import Timing, timed
from numpy.typing import NDArray
from passes import Meter, PassTimes

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.ground_truth import upload_rgba
from lapgs_wgpu.train.image_loss import ImageLoss

WEIGHTS = LossWeights(0.8, 0.2, pyramid=0.2, ncc=0.05)  # the paper's


@dataclass(frozen=True)
class LossReport:
    """Forward and backward together. kernels: from an image on the device to its gradient there, and the terms' values
    on the host. references: torch, in float32, on the processor."""

    size: int
    kernels: Timing
    references: Timing
    passes: PassTimes | None
    difference: float  # of the gradients, |kernels - references| / |references|


def bench_losses(device: Device, size: int, meter: Meter | None, repeat: int) -> LossReport:
    """With a picture of noise: the time does not depend on what is in it."""
    rng = np.random.default_rng(0)
    picture, truth = rng.random((3, size, size), np.float32), rng.integers(0, 256, (size, size, 3), np.uint8)
    planes = DeviceArray.upload(device, "image", np.concatenate([picture, picture[:1]]))
    held, losses = upload_rgba(device, truth), ImageLoss(device)

    def kernels() -> DeviceArray:
        planes.buffer.version += 1  # as if it were newly drawn
        with Commands(device) as commands:
            terms, d_image = losses.record(commands, planes, held, WEIGHTS)
        terms.read()
        return d_image

    image = torch.from_numpy(np.ascontiguousarray(picture.transpose(1, 2, 0))).requires_grad_()
    target = torch.from_numpy(truth.astype(np.float32) / 255)

    def references() -> NDArray[np.float32]:
        (gradient,) = torch.autograd.grad(total(image, target, WEIGHTS), image)
        return gradient.permute(2, 0, 1).numpy()

    ours, theirs = kernels().read()[:3], references()
    return LossReport(
        size=size,
        kernels=timed(kernels, repeat),
        references=timed(references, repeat),
        passes=meter(kernels, {}, repeat) if meter else None,
        difference=float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)),
    )
