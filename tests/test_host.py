"""What a training asks of its host: threads of torch in a step; blocks of freed memory that are not cleared again."""

import dataclasses
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from synthetic import write_synthetic

from lapgs_wgpu import Parts, Regularizer, Trainer, load_config, load_dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.host import step_threads


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


SCRIPT = """
import resource, sys
import torch
from lapgs_wgpu.train.host import keep_freed_memory

if sys.argv[1] == "keep":
    keep_freed_memory()
torch.set_num_threads(1)
for i in range(20):
    if i == 15:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [torch.full((5_000_000,), 1.0) for _ in range(5)]
    del blocks
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(how: str) -> int:
    """Of a process that fills five blocks of 20 MB five times, after it has done so before."""
    command = [sys.executable, "-c", SCRIPT, how]
    # As glibc starts. Later it raises both on its own, and gives back or not as the heap happens to end.
    start = os.environ | {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072"}
    return int(subprocess.run(command, check=True, capture_output=True, text=True, timeout=120, env=start).stdout)


@pytest.mark.nightly
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_freed_memory_is_used_again() -> None:
    assert page_faults("keep") < 100
    assert page_faults("default") > 5 * 100  # else there would be nothing to gain
