"""The image losses of the reference: each against its definition in float64, and their sum."""

from collections.abc import Callable

import pytest
import torch
from helpers.loss_reference import l1, ncc_loss, noisy_pair, pyramid_loss, total
from torch import Tensor

from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.image_loss import pyramid_sizes, pyramid_weights
from lapgs_wgpu.train.image_metrics import ssim


def test_loss_is_the_weighted_sum_of_its_parts() -> None:
    a, b = noisy_pair(15, 9)
    expected = 0.8 * (a - b).abs().mean().item() + 0.2 * (1 - ssim(a, b).item())
    assert total(a, b, LossWeights(0.8, 0.2)).item() == pytest.approx(expected, abs=1e-12)
    assert total(a, b, LossWeights(1.0, 0.0)) == l1(a, b)
    more = expected + 0.3 * pyramid_loss(a, b).item() + 0.4 * ncc_loss(a, b).item()
    assert total(a, b, LossWeights(0.8, 0.2, 0.3, 0.4)).item() == pytest.approx(more, abs=1e-12)


def test_pyramid_of_a_dot_by_hand() -> None:
    """5x5, a dot in the middle: the first level below is 3x3, then 2x2, where division ends."""
    assert pyramid_sizes(5, 5) == [(5, 5), (3, 3), (2, 2)]
    assert pyramid_weights(3) == pytest.approx([4 / 7, 2 / 7, 1 / 7])
    a = torch.zeros(5, 5, 3, dtype=torch.float64)
    a[2, 2] = 1.0
    below = torch.tensor([2.0, 6, 2], dtype=torch.float64) / 16  # of the dot, and of its reflections at the ends
    enlarge = torch.tensor([[6.0, 2, 0], [4, 4, 0], [1, 6, 1], [0, 4, 4], [0, 2, 6]], dtype=torch.float64) / 8
    reduce = torch.tensor([[6.0, 8, 2], [2, 8, 6]], dtype=torch.float64) / 16
    again = torch.tensor([[6.0, 2], [4, 4], [2, 6]], dtype=torch.float64) / 8
    first = a[..., 0] - torch.outer(enlarge @ below, enlarge @ below)
    second = torch.outer(below, below) - torch.outer(again @ reduce @ below, again @ reduce @ below)
    third = torch.outer(reduce @ below, reduce @ below)
    expected = (4 * first.abs().mean() + 2 * second.abs().mean() + third.abs().mean()) / 7
    assert pyramid_loss(a, torch.zeros_like(a)).item() == pytest.approx(expected.item(), rel=1e-12)


def test_ncc_of_flat_images() -> None:
    """By its definition what is flat agrees with everything: that is left to the other losses."""
    a, _ = noisy_pair(20, 20)
    flat = torch.full_like(a, 0.3)
    assert ncc_loss(flat, flat + 0.4).item() == pytest.approx(0, abs=2e-3)
    assert ncc_loss(flat, a).item() == pytest.approx(0, abs=2e-3)
    assert ncc_loss(flat + 0.02 * torch.rand_like(a), a).item() > 0.5


def test_ncc_is_its_definition() -> None:
    a, b = noisy_pair(13, 12)
    weights = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64)
    values = []
    for y in range(3):
        for x in range(2):
            p, q = ((one @ weights)[y : y + 11, x : x + 11] for one in (a, b))
            covariance = ((p - p.mean()) * (q - q.mean())).mean()
            values.append((covariance + 1e-4) / ((p.var(correction=0) * q.var(correction=0)).sqrt() + 1e-4))
    assert ncc_loss(a, b).item() == pytest.approx(1 - torch.stack(values).mean().item(), abs=1e-9)


def test_ncc_of_an_image_without_a_window() -> None:
    a, b = noisy_pair(10, 40)
    assert ncc_loss(a.requires_grad_(), b) == 0
    ncc_loss(a, b).backward()
    assert a.grad is not None
    assert not a.grad.any()


@pytest.mark.parametrize("size", [(2, 4), (3, 4), (12, 13)])
@pytest.mark.parametrize("loss", [pyramid_loss, ncc_loss])
def test_gradients_of_pyramid_and_ncc(loss: Callable[[Tensor, Tensor], Tensor], size: tuple[int, int]) -> None:
    a, b = noisy_pair(*size)
    assert torch.autograd.gradcheck(lambda image: loss(image, b), a.requires_grad_())
