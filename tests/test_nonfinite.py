"""Values that are not finite: named in the step in which they appear, kept from what lasts, and a reason to stop."""

import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.training import configure

from lapgs_wgpu.command import guarded
from lapgs_wgpu.data import Dataset
from lapgs_wgpu.errors import NumericalError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import resume, train
from lapgs_wgpu.train import exchange_step
from lapgs_wgpu.train.exchange_step import RenderLoss
from lapgs_wgpu.train.run_folder import STATE, load_state
from lapgs_wgpu.train.trainer import Trainer


class Spoiled(torch.autograd.Function):
    """The identity, whose gradient has one bad value."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, bad: float) -> torch.Tensor:
        ctx.bad = bad
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[torch.Tensor, None]:
        gradient = gradients[0].clone()
        gradient.view(-1)[7] = ctx.bad
        return gradient, None


def spoil(monkeypatch: pytest.MonkeyPatch, when: Callable[[int], bool], bad: float) -> None:
    """Put a bad value into the gradient of the scales at the steps of these numbers, counted from 1."""
    original, calls = exchange_step.render_loss, 0

    def render(gaussians: Any, *rest: Any) -> RenderLoss:
        nonlocal calls
        calls += 1
        if when(calls):
            object.__setattr__(gaussians, "scales", Spoiled.apply(gaussians.scales, bad))
        return original(gaussians, *rest)

    monkeypatch.setattr(exchange_step, "render_loss", render)


def same(a: dict[str, Any], b: dict[str, Any]) -> set[str]:
    """The names of what differs."""
    assert a.keys() == b.keys()
    return {name for name in a if not np.array_equal(a[name], b[name])}


@pytest.mark.parametrize("bad", [math.nan, 1e25])
@pytest.mark.parametrize("at", [5, 16], ids=["warm-up", "moving"])
def test_a_bad_gradient_skips_the_step_and_leaves_everything_as_it_was(
    at: int, bad: float, dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil(monkeypatch, lambda step: step == at, bad)
    # Ahead of any change of density, which a skipped step does not put off.
    training = Trainer(configure(density__start="30", data__background="black"), dataset, device)
    with closing(training):
        for _ in range(at - 1):
            assert training.step().skipped is None
        before = {name: value.copy() for name, value in training.state().items()}
        progress = training.step()
        assert progress.skipped is not None
        assert progress.skipped.step == at
        assert progress.skipped.view == dataset.train[before["training.order"][0]].name
        assert "the gradient of log_scales is not finite, or too large" in progress.skipped.what
        after = {name: value.copy() for name, value in training.state().items()}
        assert same(before, after) == {"training.done", "training.order"} | ({"training.random"} if at == 16 else set())
        np.testing.assert_array_equal(after["training.order"], before["training.order"][1:])
        assert training.step().skipped is None
        assert {"gaussians.means", "adam.means.0.exp_avg", "statistics.views"} <= same(after, training.state())


def test_a_bad_loss_is_named_by_its_term(dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    original = exchange_step.render_loss

    def render(*arguments: Any) -> RenderLoss:
        done = original(*arguments)
        return done._replace(loss=done.loss * math.nan, terms={**done.terms, "ssim": math.nan})

    monkeypatch.setattr(exchange_step, "render_loss", render)
    with closing(Trainer(configure(), dataset, device)) as training:
        skipped = training.step().skipped
    assert skipped is not None
    assert skipped.what.startswith("the loss term ssim is nan; ")


def test_a_training_that_stays_bad_stops_with_its_state(
    data: Path, dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    config = configure(data__path=str(data), density__start="100")
    with monkeypatch.context() as patched:
        spoil(patched, lambda step: step > 4, math.nan)
        code = guarded("lapgs-train", lambda _: train(config, dataset, tmp_path / "run", device=device) and 0, [])
    assert code == 5
    error = capfd.readouterr().err
    assert "step 5 was skipped: on view train_" in error
    last = error.splitlines()[-1]
    assert last.startswith("lapgs-train: 10 steps in a row had values that are not finite; the last: step 14 was")
    assert last.endswith(f"stopped after step 14, from which lapgs-train --resume {tmp_path / 'run'} goes on.")
    state = load_state(tmp_path / "run")
    assert state is not None
    assert state["training.done"] == 14
    assert all(np.isfinite(value).all() for value in state.values())
    resume(config, dataset, tmp_path / "run", device=device)
    assert (tmp_path / "run" / "metrics.json").exists()


def test_a_bad_parameter_stops_the_training_and_leaves_the_older_state(
    dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody else would see it: the rasterizer culls such a Gaussian, and it has no gradient."""
    original, calls = exchange_step.render_loss, 0

    def render(gaussians: Any, *rest: Any) -> RenderLoss:
        nonlocal calls
        calls += 1
        if calls == 14:
            # As a fault in memory might: after the step has read it.
            trainings[0].scene.parameters["means"].data[3, 1] = math.nan
        return original(gaussians, *rest)

    trainings: list[Trainer] = []
    prepare = Trainer.__init__

    def note(self: Trainer, *given: Any, **more: Any) -> None:
        trainings.append(self)
        prepare(self, *given, **more)

    monkeypatch.setattr(Trainer, "__init__", note)
    monkeypatch.setattr(exchange_step, "render_loss", render)
    out = tmp_path / "run"
    with pytest.raises(NumericalError, match=r"^the parameters means are not finite, or too large; .* saved last"):
        train(configure(schedule__save_interval="10"), dataset, out, device=device)
    state = load_state(out)
    assert state is not None
    assert state["training.done"] == 10
    assert np.isfinite(state["gaussians.means"]).all()
    assert (out / STATE).exists()
