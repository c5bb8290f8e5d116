"""The dynamics attribute: who stands out, and what the loss and its gradient are, against hand computations."""

import pytest
import torch
from torch import Tensor

from lapgs_wgpu.motion.fields.dynamics import dynamics_loss, outliers


def column(values: list[float]) -> Tensor:
    """(N, 16) rows that differ in one entry."""
    d = torch.zeros(len(values), 16)
    d[:, 3] = torch.tensor(values)
    return d


def spread(last: float) -> Tensor:
    """Seven rows of mean zero, at distances 0, 1, 1, 3, 3 from it, and the last two at this one."""
    d = column([0.0, 1.0, -1.0, 3.0, -3.0, 0.0, 0.0])
    d[5:, 7] = torch.tensor([last, -last])
    return d


def far_in_all_entries() -> Tensor:
    """Two rows 4 away, as there are 16 entries, and two 5 away; the bound is 1.8 + 2.227 = 4.03."""
    d = torch.zeros(10, 16)
    d[:2], d[2:4, 0] = torch.tensor([[1.0], [-1.0]]), torch.tensor([5.0, -5.0])
    return d


@pytest.mark.parametrize(
    ("d", "out"),
    [
        (spread(4.0), [5, 6]),  # mean 16/7, mean square 52/7: the bound is 2.286 + 1.485 = 3.77
        (spread(3.4), []),  # it moves with the distances; mean 14.8/7, mean square 43.12/7: 2.114 + 1.300 = 3.414
        (spread(3.6), [5, 6]),  # the deviation is that of all rows; a sample's, 1.53, would let none stand out
        (spread(4.0) + torch.linspace(-3, 3, 16), [5, 6]),  # the distance is that from the mean row
        (far_in_all_entries(), [2, 3]),  # and Euclidean
    ],
)
def test_outliers_of_crafted_sets(d: Tensor, out: list[int]) -> None:
    assert outliers(d).nonzero()[:, 0].tolist() == out


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_nobody_stands_out_among_equals(count: int, recwarn: pytest.WarningsRecorder) -> None:
    # 0.1 is no binary fraction: the mean differs from each of the rows in the last bit.
    assert outliers(torch.full((count, 16), 0.1)).tolist() == [False] * count
    assert not recwarn.list


def test_nobody_stands_out_where_all_are_equally_far() -> None:
    directions = torch.randn(500, 16, generator=torch.Generator().manual_seed(2))
    directions /= directions.norm(dim=1, keepdim=True)  # of length 1 but for rounding
    assert not outliers(torch.cat([directions, -directions])).any()
    assert not outliers(column([0.1, 0.7] * 500)).any()


def test_literal_is_the_papers_equation() -> None:
    d = spread(4.0).requires_grad_()
    loss = dynamics_loss(d)
    loss.backward()
    assert loss.item() == pytest.approx(2 * 4.0**2 / 7)
    expected = torch.zeros(7, 16)
    expected[5:, 7] = torch.tensor([2 * 4.0 / 7, -2 * 4.0 / 7])  # descent goes to the mean row, which stays constant
    assert torch.allclose(d.grad, expected, rtol=1e-6)


def test_the_mean_row_is_constant() -> None:
    # Its own gradient would spread over all rows where the outliers do not balance each other.
    d = column([0.0, 0.0, 0.0, 0.0, 8.0]).requires_grad_()
    dynamics_loss(d).backward()
    assert d.grad[:4].count_nonzero() == 0
    assert d.grad[4, 3].item() == pytest.approx(2 * (8 - 8 / 5) / 5)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-12, 1.0, 1e6])
def test_finite_at_every_scale(scale: float) -> None:
    d = (scale * torch.randn(200, 16, generator=torch.Generator().manual_seed(1))).requires_grad_()
    loss = dynamics_loss(d)
    loss.backward()
    assert loss.isfinite()
    assert d.grad.square().isfinite().all()  # as Adam's second moment
    if scale == 0:
        assert loss.item() == 0
        assert d.grad.count_nonzero() == 0


@pytest.mark.parametrize("count", [0, 1])
def test_no_gaussians_and_a_single_one(count: int) -> None:
    d = torch.ones(count, 16, requires_grad=True)
    loss = dynamics_loss(d)
    loss.backward()
    assert loss.item() == 0
    assert d.grad.count_nonzero() == 0
