"""Several views a step."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.training import configure

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.train.trainer import Trainer


def test_gradients_of_a_step_are_the_mean_over_its_views(
    dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the density control's are those of the views, not of their share in the mean."""
    found: list[tuple[dict[str, list[torch.Tensor]], torch.Tensor]] = []
    for views in ([0], [1], [0, 1]):
        config = configure(schedule__batch=str(len(views)), schedule__warm_up="0", smoothness__share="0")
        training = Trainer(config, dataset, device)
        training._draws.order.left = list(views)
        monkeypatch.setattr(training._learners.optimizer, "step", lambda step, share: None)
        training.step()
        gradients = {name: [g.clone() for g in group] for name, group in training._learners.gradients().items()}
        found.append((gradients, training._density.statistics.gradients.clone()))
        training.close()
    (first, seen_first), (second, seen_second), (both, seen_both) = found
    for name, group in both.items():
        for mean, a, b in zip(group, first[name], second[name], strict=True):
            torch.testing.assert_close(mean, (a + b) / 2, rtol=1e-4, atol=1e-8)
    torch.testing.assert_close(seen_both, seen_first + seen_second, rtol=1e-4, atol=1e-9)


@pytest.mark.nightly
def test_a_batch_repeats_to_the_last_bit(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    for name in ("a", "b"):
        train(configure(schedule__batch="3", schedule__steps="14"), dataset, tmp_path / name, device=device)
    assert (tmp_path / "a" / "checkpoint.ply").read_bytes() == (tmp_path / "b" / "checkpoint.ply").read_bytes()
