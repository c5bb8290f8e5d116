"""The optimizer: schedules, and Adam's state while Gaussians come and go."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.optimizer import Optimizer

RATES = {"means": Rate(1e-2, 1e-3, 10), "weights": Rate(5e-2, 5e-2, 1), "mlp": Rate(1e-3, 1e-3, 1)}


def make(rows: int = 6) -> tuple[dict[str, nn.Parameter], nn.Parameter, Optimizer]:
    generator = torch.Generator().manual_seed(1)
    gaussians = {
        "means": nn.Parameter(torch.randn(rows, 3, generator=generator)),
        "weights": nn.Parameter(torch.randn(rows, generator=generator)),
    }
    mlp = nn.Parameter(torch.randn(4, 4, generator=generator))
    return gaussians, mlp, Optimizer(gaussians, {"mlp": [mlp]}, RATES)


def run(
    optimizer: Optimizer, gaussians: dict[str, nn.Parameter], mlp: nn.Parameter, steps: range, rows: Tensor
) -> None:
    """Steps down a bowl whose shape differs from row to row; rows: the rows' numbers."""
    for step in steps:
        optimizer.zero_grad()
        stretch = 1.0 + rows
        loss = (gaussians["means"].square().sum(1) * stretch).sum() + (gaussians["weights"] * stretch).square().sum()
        (loss + mlp.square().sum()).backward()
        optimizer.step(step)


def test_rate_is_exponential_and_then_constant() -> None:
    rate = Rate(8e-4, 8e-6, 35_000)
    assert rate.at(0) == pytest.approx(8e-4)
    assert rate.at(17_500) == pytest.approx(8e-5)
    assert rate.at(35_000) == pytest.approx(8e-6)
    assert rate.at(50_000) == pytest.approx(8e-6)
    with pytest.raises(ValueError, match="at least 0"):
        Rate(-1e-3, 1e-3, 10)


def test_step_is_adam_at_the_rate_of_the_step() -> None:
    gaussians, mlp, optimizer = make()
    before = gaussians["means"].detach().clone()
    run(optimizer, gaussians, mlp, range(1, 2), torch.arange(6.0))
    # With eps 1e-15 the first step moves each value by the learning rate, against its gradient.
    expected = before - RATES["means"].at(1) * before.sign()
    assert torch.allclose(gaussians["means"], expected, atol=1e-7)


def test_a_step_at_a_share_of_the_rates() -> None:
    gaussians, mlp, optimizer = make()
    before, weights = gaussians["means"].detach().clone(), mlp.detach().clone()
    (gaussians["means"].square().sum() + mlp.square().sum()).backward()
    optimizer.step(1, 0.25)
    assert torch.allclose(gaussians["means"], before - 0.25 * RATES["means"].at(1) * before.sign(), atol=1e-7)
    assert torch.allclose(mlp, weights - 0.25 * RATES["mlp"].at(1) * weights.sign(), atol=1e-7)


def test_no_rate_exceeds_the_highest_one_of_its_group() -> None:
    gaussians, mlp, optimizer = make()
    optimizer.highest = {"mlp": 0.1 * RATES["mlp"].at(1)}
    means, weights = gaussians["means"].detach().clone(), mlp.detach().clone()
    run(optimizer, gaussians, mlp, range(1, 2), torch.arange(6.0))
    assert torch.allclose(gaussians["means"], means - RATES["means"].at(1) * means.sign(), atol=1e-7)
    assert torch.allclose(mlp, weights - 0.1 * RATES["mlp"].at(1) * weights.sign(), atol=1e-7)


def test_what_a_step_writes_is_counted() -> None:
    """By which a viewer sees that a parameter has changed."""
    gaussians, mlp, optimizer = make()
    parameters = [*gaussians.values(), mlp]
    for steps in (range(1, 2), range(2, 3)):
        versions = [parameter._version for parameter in parameters]
        run(optimizer, gaussians, mlp, steps, torch.arange(6.0))
        assert all(parameter._version > before for parameter, before in zip(parameters, versions, strict=True))


def test_kept_rows_go_on_as_if_nothing_had_happened() -> None:
    numbers = torch.arange(6.0)
    gaussians, mlp, optimizer = make()
    run(optimizer, gaussians, mlp, range(1, 5), numbers)
    keep = torch.tensor([True, False, True, True, False, True])
    optimizer.edit_rows(keep, {"means": torch.ones(2, 3), "weights": torch.ones(2)})
    assert gaussians["means"].shape == (6, 3)
    run(optimizer, gaussians, mlp, range(5, 9), torch.cat([numbers[keep], torch.tensor([7.0, 8.0])]))

    whole, other_mlp, undisturbed = make()
    run(undisturbed, whole, other_mlp, range(1, 9), numbers)
    for name in gaussians:
        assert torch.equal(gaussians[name][:4], whole[name][keep])
        for key, moment in optimizer.moments(name).items():
            assert torch.equal(moment[:4], undisturbed.moments(name)[key][keep])
    assert torch.equal(mlp, other_mlp)


def test_new_rows_start_with_zero_moments_and_move() -> None:
    gaussians, mlp, optimizer = make()
    run(optimizer, gaussians, mlp, range(1, 4), torch.arange(6.0))
    optimizer.edit_rows(torch.ones(6, dtype=torch.bool), {"means": torch.ones(1, 3), "weights": torch.ones(1)})
    for name in gaussians:
        moments = optimizer.moments(name)
        assert set(moments) == {"exp_avg", "exp_avg_sq"}
        assert all((moment[6:] == 0).all() and (moment[:6] != 0).all() for moment in moments.values())
    run(optimizer, gaussians, mlp, range(4, 5), torch.arange(7.0))
    assert (gaussians["means"][6] < 1).all()


def test_reset_forgets_momentum_of_one_parameter_alone() -> None:
    gaussians, mlp, optimizer = make()
    run(optimizer, gaussians, mlp, range(1, 4), torch.arange(6.0))
    kept = optimizer.moments("means")["exp_avg"].clone()
    optimizer.reset("weights", torch.full((6,), 0.5))
    assert (gaussians["weights"] == 0.5).all()
    assert all((moment == 0).all() for moment in optimizer.moments("weights").values())
    assert torch.equal(optimizer.moments("means")["exp_avg"], kept)
    run(optimizer, gaussians, mlp, range(4, 5), torch.arange(6.0))
    assert (gaussians["weights"] < 0.5).all()
