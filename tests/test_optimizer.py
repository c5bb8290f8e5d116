"""The optimizer: schedules, and Adam's state while Gaussians come and go."""

import pytest
import torch
from torch import Tensor, nn

from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.optimizer import Optimizer, rate_at

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
        optimizer._adam.zero_grad()
        stretch = 1.0 + rows
        loss = (gaussians["means"].square().sum(1) * stretch).sum() + (gaussians["weights"] * stretch).square().sum()
        (loss + mlp.square().sum()).backward()
        optimizer.step(step)


def test_rate_is_exponential_and_then_constant() -> None:
    rate = Rate(8e-4, 8e-6, 35_000)
    assert rate_at(rate, 0) == pytest.approx(8e-4)
    assert rate_at(rate, 17_500) == pytest.approx(8e-5)
    assert rate_at(rate, 35_000) == pytest.approx(8e-6)
    assert rate_at(rate, 50_000) == pytest.approx(8e-6)
    with pytest.raises(ValueError, match="at least 0"):
        Rate(-1e-3, 1e-3, 10)


@pytest.mark.parametrize(("share", "highest"), [(1.0, None), (0.25, None), (1.0, 0.1), (0.5, 0.1)])
def test_a_step_is_adam_at_a_share_of_the_rates_and_at_most_the_highest(share: float, highest: float | None) -> None:
    """With eps 1e-15 the first step moves each value by the learning rate, against its gradient."""
    gaussians, mlp, optimizer = make()
    rates = {name: rate_at(rate, 1) for name, rate in RATES.items()}
    if highest is not None:
        rates["mlp"] *= highest
        optimizer.highest = {"mlp": rates["mlp"]}
    means, weights = gaussians["means"].detach().clone(), mlp.detach().clone()
    (gaussians["means"].square().sum() + mlp.square().sum()).backward()
    optimizer.step(1, share)
    assert torch.allclose(gaussians["means"], means - share * rates["means"] * means.sign(), atol=1e-7)
    assert torch.allclose(mlp, weights - share * rates["mlp"] * weights.sign(), atol=1e-7)


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
