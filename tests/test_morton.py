"""The order of Gaussians along a Morton curve."""

import pytest
import torch

from lapgs_wgpu.splat.morton import morton_order


def test_the_curve_written_out() -> None:
    """The eight corners of a cube twice as fine: z decides over y over x."""
    corners = torch.tensor([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
    shuffled = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(corners[shuffled][morton_order(corners[shuffled])], corners)
    halves = torch.cat([corners, 0.25 * corners])  # the small cube lies in the large one's first eighth
    assert morton_order(halves).tolist()[:9] == [0, 8, 9, 10, 11, 12, 13, 14, 15]


@pytest.mark.parametrize("count", [0, 1, 2, 5000])
def test_an_order_that_repeats(count: int) -> None:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([1e-3, 1.0, 1e3])
    order = morton_order(points)
    assert order.dtype == torch.int64
    assert sorted(order.tolist()) == list(range(count))
    assert torch.equal(order, morton_order(points))
    assert morton_order(points[order]).tolist() == list(range(count))


def test_neighbours_come_near_one_another() -> None:
    points = torch.rand(4096, 3, generator=torch.Generator().manual_seed(2))
    steps = points[morton_order(points)].diff(dim=0).norm(dim=1)
    assert steps.mean() < 0.15  # at random 0.66; a cell of a point is 1/16 wide
