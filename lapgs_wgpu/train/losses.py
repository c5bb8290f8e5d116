"""Image losses and measures: L1, SSIM, PSNR. Images are (H, W, 3) in [0, 1]; all sums are in a fixed order."""

from __future__ import annotations

import functools

import torch
from torch import Tensor
from torch.nn import functional

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5  # pixels
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
LEAST_ERROR = 1e-10  # mean squared error that PSNR takes equal images to have: 100 dB


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM), a scalar; with w = 0.2 the loss of 3DGS (Kerbl et al. 2023)."""
    difference = l1(image, target)
    if ssim_weight == 0:
        return difference
    return (1 - ssim_weight) * difference + ssim_weight * (1 - ssim(image, target))


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (image - target).abs().mean()


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity (Wang et al. 2004) of two (H, W, C) images, as 3DGS and its successors report it.

    A Gaussian window of 11x11 pixels and sigma 1.5; beyond the border lies zero, and the mean is over all pixels.
    (Other libraries leave the border out or pad it otherwise, and give other numbers.)
    """
    a, b = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_a, mean_b, aa, bb, ab = _blur(torch.cat([a, b, a * a, b * b, a * b])).chunk(5)
    covariance = ab - mean_a * mean_b
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    return (luminance * (2 * covariance + SSIM_C2) / (variances + SSIM_C2)).mean()


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels, at most 100 dB."""
    error = (image - target).square().mean().clamp(min=LEAST_ERROR)
    return -10.0 * float(torch.log10(error))


def _blur(planes: Tensor) -> Tensor:
    """(P, H, W) planes under the Gaussian window, rows and columns in turn."""
    window = _window(planes.dtype, planes.device)
    count, margin = len(planes), SSIM_WINDOW // 2
    columns = window.view(1, 1, -1, 1).expand(count, 1, -1, 1)
    rows = window.view(1, 1, 1, -1).expand(count, 1, 1, -1)
    down = functional.conv2d(planes[None], columns, padding=(margin, 0), groups=count)
    return functional.conv2d(down, rows, padding=(0, margin), groups=count)[0]


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(11,) the window along one axis; its sum is 1."""
    x = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-x * x / (2 * SSIM_SIGMA**2))
    return (weights / weights.sum()).to(dtype=dtype, device=device)
