"""Image losses: SSIM against its definition in float64, the loss's parts, PSNR."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from lapgs_wgpu.train.losses import l1, photometric_loss, psnr, ssim


def pair(height: int, width: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(height * 1000 + width)
    a, noise = torch.rand((2, height, width, 3), generator=generator, dtype=dtype)
    return a, 0.7 * a + 0.3 * noise


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
    a, b = pair(*size)
    assert ssim(a, b).item() == pytest.approx(ssim_by_definition(a, b), abs=1e-12)


def test_ssim_of_equal_images_is_one_and_its_gradient_zero() -> None:
    a, _ = pair(20, 31, torch.float32)
    a.requires_grad_()
    value = ssim(a, a.detach())
    value.backward()
    assert value.item() == pytest.approx(1, abs=1e-6)
    assert a.grad is not None
    assert a.grad.abs().max() < 1e-6


def test_ssim_gradient() -> None:
    a, b = pair(6, 13)
    assert torch.autograd.gradcheck(lambda image: ssim(image, b), a.requires_grad_())


def test_ssim_is_precise_in_float32() -> None:
    a, b = pair(40, 50)
    assert ssim(a.float(), b.float()).item() == pytest.approx(ssim(a, b).item(), abs=2e-6)


def test_loss_is_the_weighted_sum_of_its_parts() -> None:
    a, b = pair(15, 9)
    expected = 0.8 * (a - b).abs().mean().item() + 0.2 * (1 - ssim_by_definition(a, b))
    assert photometric_loss(a, b, 0.2).item() == pytest.approx(expected, abs=1e-12)
    assert photometric_loss(a, b, 0.0) == l1(a, b)


def test_psnr() -> None:
    a = torch.zeros(4, 5, 3)
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert psnr(a, a) == pytest.approx(100)  # the bound for equal images
