"""Measures of images, each against its definition in float64."""

import math

import pytest
import torch
from helpers.loss_reference import noisy_pair
from torch import Tensor

from lapgs_wgpu.train.image_metrics import psnr, psnr_of, ssim


def ssim_by_definition(a: Tensor, b: Tensor) -> float:
    """The sum over each pixel's 11x11 window, one by one; zeros beyond the border."""
    height, width, channels = a.shape
    weights = [math.exp(-((k - 5) ** 2) / (2 * 1.5**2)) for k in range(11)]
    norm = sum(weights) ** 2
    total = 0.0
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                sums = [0.0] * 5
                for dy in range(-5, 6):
                    for dx in range(-5, 6):
                        if 0 <= y + dy < height and 0 <= x + dx < width:
                            w = weights[dy + 5] * weights[dx + 5] / norm
                            p, q = a[y + dy, x + dx, c].item(), b[y + dy, x + dx, c].item()
                            for i, value in enumerate((p, q, p * p, q * q, p * q)):
                                sums[i] += w * value
                mu, nu, pp, qq, pq = sums
                above = (2 * mu * nu + 1e-4) * (2 * (pq - mu * nu) + 9e-4)
                total += above / ((mu * mu + nu * nu + 1e-4) * (pp - mu * mu + qq - nu * nu + 9e-4))
    return total / (height * width * channels)


@pytest.mark.parametrize("size", [(1, 1), (4, 7), (13, 12)])
def test_ssim_is_its_definition(size: tuple[int, int]) -> None:
    a, b = noisy_pair(*size)
    assert ssim(a, b).item() == pytest.approx(ssim_by_definition(a, b), abs=1e-12)


def test_ssim_of_equal_images_is_one_and_its_gradient_zero() -> None:
    a, _ = noisy_pair(20, 31, torch.float32)
    a.requires_grad_()
    value = ssim(a, a.detach())
    value.backward()
    assert value.item() == pytest.approx(1, abs=1e-6)
    assert a.grad is not None
    assert a.grad.abs().max() < 1e-6


def test_ssim_gradient() -> None:
    a, b = noisy_pair(6, 13)
    assert torch.autograd.gradcheck(lambda image: ssim(image, b), a.requires_grad_())


def test_psnr() -> None:
    a = torch.zeros(4, 5, 3)
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert psnr(a, a) == pytest.approx(100)  # the bound for equal images
    assert psnr_of(1e-3) == pytest.approx(30)
    assert math.isnan(psnr_of(math.nan))
