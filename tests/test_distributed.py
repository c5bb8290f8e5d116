"""Several views a step, and several processes that share them."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.training import configure
from motion_scenes import MotionScene
from motion_writer import write_motion

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import load
from lapgs_wgpu.run import train
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.distributed import Ranks
from lapgs_wgpu.train.objective import Sample
from lapgs_wgpu.train.presets import write_toml
from lapgs_wgpu.train.trainer import Trainer


def test_gradients_of_a_step_are_the_mean_over_its_views(
    dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the density control's are those of the views, not of their share in the mean."""
    found: list[tuple[dict[str, list[torch.Tensor]], torch.Tensor]] = []
    for views in ([0], [1], [0, 1]):
        config = configure(schedule__batch=str(len(views)), schedule__warm_up="0", smoothness__share="0")
        training = Trainer(config, dataset, device)
        training._order.left = list(views)
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


def test_processes_share_views_evenly_or_not_at_all(dataset: Dataset, device: Device) -> None:
    with pytest.raises(InputError, match=r"2 processes cannot share 3 views a step evenly; give --batch 2"):
        Trainer(configure(schedule__batch="3"), dataset, device, Ranks(0, 2))


def test_every_process_draws_the_same_numbers_and_other_views(
    dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    original = Trainer._descend

    def note(self: Trainer, sample: Sample, **share: int) -> object:
        looked.append(sample.view.name)
        return original(self, sample, **share)

    monkeypatch.setattr(Trainer, "_descend", note)
    monkeypatch.setattr(Ranks, "all_gather", lambda self, tensors: [[tensor] * self.count for tensor in tensors])
    monkeypatch.setattr(Ranks, "any_rank", lambda self, here: here)
    monkeypatch.setattr(Ranks, "of_first", lambda self, value: value)
    states, views = [], []
    for rank in range(2):
        training = Trainer(configure(schedule__batch="2", schedule__warm_up="0"), dataset, device, Ranks(rank, 2))
        looked.clear()
        training.step()
        states.append(training._generator.get_state())
        views.append(list(looked))
        training.close()
    assert torch.equal(states[0], states[1])
    assert len(views[0]) == len(views[1]) == 1
    assert views[0] != views[1]


def test_all_start_as_the_first_one_does(dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Devices of different makers would not find the same."""
    config = configure(schedule__batch="2")
    with Trainer(dataclasses.replace(config, seed=7), dataset, device) as other:
        for _ in range(3):
            other.step()
        first = other.state()
    monkeypatch.setattr(Ranks, "of_first", lambda self, value: first)
    with Trainer(config, dataset, device, Ranks(1, 2)) as training:
        found = training.state()
    assert training.done == 3
    assert found.keys() == first.keys()
    assert all(np.array_equal(found[name], first[name]) for name in first)


def torchrun(config: Path, out: Path) -> str:
    """Train in two processes; returns what they printed."""
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", "0",
        "--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0", "-m", "lapgs_wgpu.cli", str(config),
        "--out", str(out),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("dB PSNR") == 1, "more than one process told of the result"
    return done.stdout + done.stderr


def check_two_processes(config: Config, dataset: Dataset, device: Device, folder: Path) -> str:
    """Two processes give the scene of one to float tolerance. Returns what they printed."""
    file = folder / "small.toml"
    file.write_text(write_toml(dataclasses.asdict(config)))
    printed = torchrun(file, folder / "two")
    train(config, dataset, folder / "one", device=device)
    one, two = (load(folder / name / "checkpoint.ply", device) for name in ("one", "two"))
    assert len(one) == len(two)
    for name, parameter in one.parameters.items():
        np.testing.assert_allclose(
            two.parameters[name].detach().numpy(), parameter.detach().numpy(), rtol=1e-3, atol=1e-4, err_msg=name
        )
    return printed


def test_two_processes_are_one_with_two_views(dataset: Dataset, data: Path, device: Device, tmp_path: Path) -> None:
    given = {"schedule__batch": "2", "schedule__steps": "12", "acceleration__weight": "1"}
    config = configure(data__path=str(data), **given)
    check_two_processes(config, dataset, device, tmp_path)


@pytest.mark.nightly
def test_two_processes_discover_the_same(device: Device, tmp_path: Path) -> None:
    data = write_motion(tmp_path / "scene", MotionScene(path=4, cycles=1), size=32, train_times=24, test_views=2)
    steps = {"schedule__steps": "46", "discovery__steps": "40", "discovery__field_steps": "20"}
    config = configure(schedule__batch="2", data__path=str(data), density__stop="0", **steps)
    printed = check_two_processes(config, load_dataset(data), device, tmp_path)
    assert "moving parts" in printed, "nothing was found that two processes could disagree about"
