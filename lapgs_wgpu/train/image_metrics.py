"""Measures of images: SSIM, MS-SSIM, PSNR. Images are (H, W, 3) in [0, 1].

In torch, differentiable, for any float dtype; all sums have a fixed order.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from lapgs_wgpu.splat.constants import CONSTANTS

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5  # pixels
SSIM_C1, SSIM_C2 = CONSTANTS["SSIM_C1"], CONSTANTS["SSIM_C2"]
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # of the scales, the finest first
MS_SSIM_SMALLEST = (SSIM_WINDOW - 1) * 2 ** (len(MS_SSIM_WEIGHTS) - 1) + 1  # 161: the coarsest has one window
DIFFERENCE = 0.1  # of a channel, from which on a pixel differs
REACH = 2  # pixels; texture that is blurred or shifted by less does not differ
LEAST_ERROR = 1e-10  # mean squared error that PSNR takes equal images to have: 100 dB


def ssim(image: Tensor, target: Tensor, pixels: Tensor | None = None) -> Tensor:
    """Mean structural similarity (Wang et al. 2004) of two (H, W, C) images, as 3DGS and its successors report it.

    A Gaussian window of 11x11 pixels and sigma 1.5; beyond the border lies zero, and the mean is over all pixels, or
    over those of a mask (H, W). (Other libraries leave the border out or pad it otherwise.)
    """
    luminance, contrast = _similarity(image.permute(2, 0, 1), target.permute(2, 0, 1))
    similar = luminance * contrast
    return similar.mean() if pixels is None else similar[:, pixels].mean()


def ms_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity over five scales (Wang et al. 2003) of two (H, W, C) images of at least
    MS_SSIM_SMALLEST pixels a side.

    Windows lie wholly inside; a scale has half the pixels of the one before, means of 2x2 (an odd border counts as
    half zeros); a channel's product over the scales, then the mean over the channels.
    """
    a, b = image.permute(2, 0, 1), target.permute(2, 0, 1)
    product = image.new_ones(())
    for level, weight in enumerate(MS_SSIM_WEIGHTS):
        luminance, contrast = (each[:, 5:-5, 5:-5] for each in _similarity(a, b))
        similar = luminance * contrast if level == len(MS_SSIM_WEIGHTS) - 1 else contrast
        product = product * similar.mean(dim=(1, 2)).clamp(min=0) ** weight
        odd = [side % 2 for side in a.shape[1:]]
        a, b = (functional.avg_pool2d(each[None], 2, padding=(odd[0], odd[1]))[0] for each in (a, b))
    return product.mean()


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels, at most 100 dB."""
    return psnr_of(float((image - target).square().flatten().mean()))  # summed in one order, whatever the strides


def psnr_of(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB of values in [0, 1], at most 100 dB."""
    return -10.0 * math.log10(max(mean_squared_error, LEAST_ERROR))


def differing_pixels(image: NDArray[np.float32], drawn: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) bool: where an image (H, W, 3) differs from one that was drawn, but for thin lines and single pixels.

    The difference is the distance of a color to the range of the drawn colors within REACH pixels, the largest over the
    channels.
    """
    size = (2 * REACH + 1, 2 * REACH + 1, 1)
    low, high = ndimage.minimum_filter(drawn, size), ndimage.maximum_filter(drawn, size)
    difference = np.maximum(np.maximum(low - image, image - high), 0.0).max(axis=2)
    core = ndimage.binary_opening(difference > DIFFERENCE)
    return ndimage.binary_dilation(core, iterations=2) & (difference > 0.5 * DIFFERENCE)


def _similarity(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """SSIM's luminance, and its contrast and structure, (C, H, W) each, of two images (C, H, W)."""
    mean_a, mean_b, aa, bb, ab = _blur(torch.cat([a, b, a * a, b * b, a * b])).chunk(5)
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    return luminance, (2 * (ab - mean_a * mean_b) + SSIM_C2) / (variances + SSIM_C2)


def _blur(planes: Tensor) -> Tensor:
    """(P, H, W) planes under the Gaussian window, rows and columns in turn."""
    x = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-x * x / (2 * SSIM_SIGMA**2))
    window = (weights / weights.sum()).to(planes)
    count, margin = len(planes), SSIM_WINDOW // 2
    columns = window.view(1, 1, -1, 1).expand(count, 1, -1, 1)
    rows = window.view(1, 1, 1, -1).expand(count, 1, 1, -1)
    down = functional.conv2d(planes[None], columns, padding=(margin, 0), groups=count)
    return functional.conv2d(down, rows, padding=(0, margin), groups=count)[0]
