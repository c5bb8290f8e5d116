"""The image losses in torch: what the kernels of train/image_loss are tested against. Images are (H, W, 3) in [0, 1].

Differentiable, for any float dtype; all sums have a fixed order.
"""

import torch
from torch import Tensor
from torch.nn import functional

from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.image_loss import NCC_WINDOW, pyramid_sizes, pyramid_weights
from lapgs_wgpu.train.image_metrics import ssim

PYRAMID_TAPS = (1.0, 4.0, 6.0, 4.0, 1.0)  # sum 16
NCC_E, NCC_TINY = CONSTANTS["NCC_E"], CONSTANTS["NCC_TINY"]
LUMINANCE = (0.299, 0.587, 0.114)  # Rec. 601, which is meant for gamma-encoded images such as ours


def noisy_pair(height: int, width: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Two random images, the second near the first."""
    generator = torch.Generator().manual_seed(height * 1000 + width)
    a, noise = torch.rand((2, height, width, 3), generator=generator, dtype=dtype)
    return a, 0.7 * a + 0.3 * noise


def exposure(image: Tensor, correction: Tensor) -> Tensor:
    """The image (H, W, 3) after a correction (3, 4)."""
    return image @ correction[:, :3].mT + correction[:, 3]


def total(image: Tensor, target: Tensor, weights: LossWeights) -> Tensor:
    """The weighted sum of all image losses, a scalar; with l1 0.8 and ssim 0.2 that of 3DGS (Kerbl et al. 2023)."""
    loss = weights.l1 * l1(image, target)
    if weights.ssim:
        loss = loss + weights.ssim * (1 - ssim(image, target))
    if weights.pyramid:
        loss = loss + weights.pyramid * pyramid_loss(image, target)
    if weights.ncc:
        loss = loss + weights.ncc * ncc_loss(image, target)
    return loss


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (image - target).abs().mean()


def pyramid_loss(image: Tensor, target: Tensor) -> Tensor:
    """Weighted mean absolute difference of the levels of two Laplacian pyramids (Burt and Adelson 1983), a scalar.

    3 band-pass levels and the low-pass residual, 5x5 binomial kernel, borders reflected (without repeating the border
    pixel); `pyramid_sizes` says what becomes of small images, `pyramid_weights` what each level counts. Since pyramids
    are linear, it is that of the difference.
    """
    level = (image - target).permute(2, 0, 1)
    sizes = pyramid_sizes(*level.shape[1:])
    loss = level.new_zeros(())
    if len(sizes) == 1:
        return 0.0 * image.sum()
    for weight, coarse in zip(pyramid_weights(len(sizes)), [*sizes[1:], None], strict=True):
        if coarse is None:
            return loss + weight * level.abs().mean()
        below = _binomial(level)[:, ::2, ::2]
        loss = loss + weight * (level - _enlarge(below, level.shape[1], level.shape[2])).abs().mean()
        level = below
    raise AssertionError("the last level is the residual")


def ncc_loss(image: Tensor, target: Tensor) -> Tensor:
    """1 - mean local normalised cross-correlation of the luminances, a scalar.

    (covariance + e) / (sqrt(variance variance + tiny) + e) over every 11x11 window that lies inside the image. Hence a
    flat window agrees with every other (what it lacks, the other losses see), and brightness and contrast do not count,
    as long as the variances are well above e. An image with a side below 11 pixels has no window: its loss is 0.
    """
    if min(image.shape[:2]) < NCC_WINDOW:
        return 0.0 * image.sum()
    weights = image.new_tensor(LUMINANCE)
    a, b = image @ weights, target @ weights
    mean_a, mean_b, aa, bb, ab = functional.avg_pool2d(torch.stack([a, b, a * a, b * b, a * b]), NCC_WINDOW, stride=1)
    covariance = ab - mean_a * mean_b
    variances = (
        (aa - mean_a * mean_a).clamp(min=0),
        (bb - mean_b * mean_b).clamp(min=0),
    )
    return 1 - ((covariance + NCC_E) / ((variances[0] * variances[1] + NCC_TINY).sqrt() + NCC_E)).mean()


def _binomial(planes: Tensor) -> Tensor:
    """(P, H, W) planes under the 5x5 binomial kernel, borders reflected; H and W are at least 3."""
    taps = planes.new_tensor(PYRAMID_TAPS) / 16
    padded = functional.pad(planes[None], (2, 2, 2, 2), mode="reflect")
    kernel = (taps[:, None] * taps).expand(len(planes), 1, 5, 5)
    return functional.conv2d(padded, kernel, groups=len(planes))[0]


def _enlarge(planes: Tensor, height: int, width: int) -> Tensor:
    """(P, height, width): planes with zeros between their pixels, under four times the kernel. A constant stays one."""
    spread = planes.new_zeros(len(planes), height, width)
    spread[:, ::2, ::2] = planes
    return 4 * _binomial(spread)
