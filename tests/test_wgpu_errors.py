"""A device that runs out of memory or is lost: one sentence, an exit code, and a state from which the run goes on."""

import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import wgpu
from conftest import open_test_device
from helpers.interrupts import after_step
from helpers.training import configure
from wgpu.backends.wgpu_native import lib

from lapgs_wgpu.command import guarded
from lapgs_wgpu.data import Dataset
from lapgs_wgpu.errors import DeviceError, DeviceLostError, DeviceMemoryError, NoAdapterError
from lapgs_wgpu.gpu import native
from lapgs_wgpu.gpu.array import Buffer, DeviceArray
from lapgs_wgpu.gpu.device import _DEFAULT_LIMITS, _RAISED_LIMITS, Device, DeviceInfo
from lapgs_wgpu.gpu.driver_errors import translated_errors
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.run import resume, train
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.run_folder import load_state

NO_MEMORY = "Validation Error\n\nCaused by:\n  In wgpuDeviceCreateBuffer\n    Not enough memory left.\n"


@pytest.fixture
def doomed(configuration: str) -> Device:
    """A device of its own."""
    return open_test_device(configuration)


def fail_to_allocate(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    def create(**_: Any) -> None:
        raise wgpu.GPUValidationError(NO_MEMORY)

    monkeypatch.setattr(device.wgpu_device, "create_buffer", create)
    rasterizer = rasterizer_of(device)  # what was made so far no longer does
    rasterizer.plans.now = replace(rasterizer.plans.now, capacity=4 * rasterizer.plans.now.capacity)


@pytest.mark.parametrize("how", ["lost", pytest.param("memory", marks=pytest.mark.nightly)])
def test_a_training_whose_device_fails_goes_on_later_to_the_same_bytes(
    how: str,
    trained_run: Path,
    dataset: Dataset,
    device: Device,
    doomed: Device,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        if how == "lost":
            after_step(14, doomed.wgpu_device.destroy, patched)
        else:
            after_step(14, lambda: fail_to_allocate(doomed, patched), patched)
        code = guarded("lapgs-train", lambda _: train(configure(), dataset, out, device=doomed) and 0, [])
    assert code == 4
    last = capfd.readouterr().err.splitlines()[-1]
    what = {
        "lost": "was lost, because its driver gave up or it was removed",
        "memory": "has no memory left for buffer '",
    }[how]
    assert last.startswith(f"lapgs-train: {doomed.info.name} {what}")
    assert last.endswith(f"; stopped after step 14, from which lapgs-train --resume {out} goes on.")
    state = load_state(out)
    assert state is not None
    assert state["training.done"] == 14
    resume(configure(), dataset, out, device=device)
    assert (out / "checkpoint.ply").read_bytes() == (trained_run / "checkpoint.ply").read_bytes()


@pytest.mark.nightly
def test_a_step_that_broke_off_halfway_is_not_saved(
    dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        np.empty(1 << 58)

    monkeypatch.setattr("lapgs_wgpu.train.densify.split_rows", fail)
    expected = r"Unable to allocate 2\.00 EiB .*; lapgs-train --resume .* goes on from the state that was saved last\."
    with pytest.raises(MemoryError, match=expected):
        train(configure(schedule__save_interval="4", density__start="9"), dataset, tmp_path, device=device)
    state = load_state(tmp_path)
    assert state is not None
    assert state["training.done"] == 8


@pytest.mark.kernels
def test_a_lost_device_is_named_wherever_it_is_used(doomed: Device) -> None:
    small, large = (DeviceArray.empty(doomed, "words", (count,), "uint32") for count in (16, 1 << 18))
    kernel = Kernel.get(doomed, "scan_reduce", SCAN_LANES=8)
    doomed.wgpu_device.destroy()

    def dispatch() -> None:
        with Commands(doomed) as commands:
            commands.dispatch(kernel, 1, length=small, values=large, block_sums=small)

    def clear() -> None:
        with Commands(doomed) as commands:
            commands.clear(large)

    def texture() -> None:
        with Commands(doomed) as commands:
            commands._texture(small, "r32float")

    uses: list[Callable[[], Any]] = [
        dispatch,
        clear,
        texture,
        lambda: Buffer(doomed, 64, "new"),
        lambda: Kernel.get(doomed, "compact"),
        lambda: small.write(np.zeros(16, np.uint32)),
        lambda: large.write(np.zeros(1 << 18, np.uint32)),
        small.read,
    ]
    for use in uses:
        with pytest.raises(DeviceLostError, match="was lost, because its driver gave up or it was removed"):
            use()


class _Deaf:
    """The native library, but polls do nothing."""

    def __getattr__(self, name: str) -> Any:
        return (lambda *_: None) if name == "wgpuDevicePoll" else getattr(lib, name)


def test_a_device_that_never_answers_is_given_up(doomed: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Metal, where macOS kills work that takes too long and the mapping that waits for it never ends."""
    array = DeviceArray.upload(doomed, "values", np.arange(4, dtype=np.uint32))
    doomed.watchdog = True
    assert array.read().tolist() == [0, 1, 2, 3]
    monkeypatch.setattr(native, "lib", _Deaf())
    monkeypatch.setattr(native, "LONGEST_WAIT", 0.2)
    begun = time.monotonic()
    with pytest.raises(DeviceLostError, match=f"{re.escape(doomed.info.name)} has not answered for 0 seconds"):
        array.read()
    assert 0.2 <= time.monotonic() - begun < 5


def test_other_errors_stay_what_they_are(device: Device) -> None:
    with pytest.raises(wgpu.GPUValidationError), translated_errors(device, "a test"):
        device.wgpu_device.create_buffer(size=1 << 60, usage=wgpu.BufferUsage.STORAGE)
    with pytest.raises(AttributeError), translated_errors(device, "a test"):
        raise AttributeError
    with (
        pytest.raises(DeviceMemoryError, match=r"no memory left for a test of 5 MB, fewer"),
        translated_errors(device, "a test", 5_000_000),
    ):
        raise wgpu.GPUOutOfMemoryError("out of memory")
    assert issubclass(DeviceMemoryError, MemoryError)
    assert issubclass(DeviceMemoryError, DeviceError)


def test_commands_tell_of_memory_in_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    def allocate_tensor(_: list[str]) -> None:
        torch.empty(1 << 60)

    def allocate_array(_: list[str]) -> None:
        np.empty(1 << 58)

    for command in (allocate_tensor, allocate_array):
        assert guarded("lapgs-view", command, []) == 4
        error = capsys.readouterr().err
        assert error.startswith("lapgs-view: ")
        assert error.count("\n") == 1
        assert "allocate" in error

    def other(_: list[str]) -> None:
        raise RuntimeError("a fault of ours")

    with pytest.raises(RuntimeError, match="a fault of ours"):
        guarded("lapgs-view", other, [])


def test_an_adapter_that_cannot_be_opened_is_named() -> None:
    def refuse(**_: Any) -> None:
        raise RuntimeError("Request device failed (1): Not enough memory left")

    limits = dict.fromkeys((*_DEFAULT_LIMITS, *_RAISED_LIMITS), 1 << 31)
    adapter = SimpleNamespace(features=(), limits=limits, request_device_sync=refuse)
    with pytest.raises(NoAdapterError, match=r"the adapter 'Broken' cannot be opened \(Request device failed"):
        Device(adapter, DeviceInfo("Broken", "discrete", "Vulkan", ""))
