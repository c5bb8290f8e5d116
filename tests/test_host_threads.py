"""How many threads torch has in a training step."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from lapgs_wgpu import Parts, Regularizer, Trainer, load_config, load_dataset
from lapgs_wgpu.data.synthetic import write_synthetic
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.host_threads import step_threads


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_one_on_a_processor_where_torch_has_little_to_share(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    small, large = load_config("tiny").field, load_config("dnerf").field
    for field in (small, large, dataclasses.replace(large, kind="static"), dataclasses.replace(small, kind="mlp")):
        assert step_threads(field, device) == (1 if device.is_cpu else None)
    for field in (dataclasses.replace(large, kind="mlp"), dataclasses.replace(large, depth=2)):
        assert step_threads(field, device) is None
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert step_threads(small, device) is None, "what the user chose stands"


@pytest.mark.usefixtures("two_threads")
def test_a_step_has_one_and_a_callback_all(device: Device, tmp_path: Path) -> None:
    if not device.is_cpu:
        pytest.skip("only CPU devices share their processor with torch")
    within, after = [], []

    def look(*_: object) -> torch.Tensor:
        within.append(torch.get_num_threads())
        return torch.zeros(())

    config = load_config("tiny", {"points.count": "50", "schedule.steps": "1", "schedule.warm_up": "0"})
    data = load_dataset(write_synthetic(tmp_path / "scene", size=16, train_views=2, test_views=1))
    parts = Parts(losses=[Regularizer("look", look, 1.0)], callbacks=[lambda *_: after.append(torch.get_num_threads())])
    with Trainer(config, data, device, parts=parts) as trainer:
        trainer.step()
    assert within == [1]
    assert after == [2]
