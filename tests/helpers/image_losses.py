"""A step with a loss of the image."""

from typing import NamedTuple

import numpy as np
import torch
from helpers.scenes import oblique_camera, random_scene
from numpy.typing import NDArray

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.exchange_step import RenderLoss, render_loss
from lapgs_wgpu.train.ground_truth import upload_rgba

WEIGHTS = {
    "l1": LossWeights(1.0, 0.0),
    "ssim": LossWeights(0.0, 1.0),
    "pyramid": LossWeights(0.0, 0.0, pyramid=1.0),
    "ncc": LossWeights(0.0, 0.0, ncc=1.0),
    "all": LossWeights(0.8, 0.2, pyramid=0.2, ncc=0.05),
}
Picture = NDArray[np.float32]


class Pair(NamedTuple):
    """An image (H, W, 3) and its ground truth in 8 bits."""

    image: Picture
    truth: NDArray[np.uint8]


def random_pair(height: int, width: int) -> Pair:
    rng = np.random.default_rng(1000 * height + width)
    return Pair(rng.random((height, width, 3), np.float32), rng.integers(0, 256, (height, width, 3), np.uint8))


CAMERA = oblique_camera(61, 47)
TRUTH = random_pair(CAMERA.height, CAMERA.width).truth
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def gaussians(count: int = 200, *, antialiased: bool | float = False, **changes: torch.Tensor) -> Gaussians:
    scene = random_scene(count, 1, sh=4)
    tensors = {"sh" if name == "colors" else name: value for name, value in scene.items()} | changes
    return Gaussians(
        **{name: value.clone().requires_grad_() for name, value in tensors.items()}, antialiased=antialiased
    )


def step(device: Device, scene: Gaussians, weights: LossWeights = WEIGHTS["all"]) -> RenderLoss:
    return render_loss(scene, CAMERA, upload_rgba(device, TRUTH), BACKGROUND, weights, device)


def gradients(scene: Gaussians, done: RenderLoss) -> dict[str, torch.Tensor]:
    return {name: t.grad for name, t in (scene.arrays() | {"means2d": done.means2d}).items()}
