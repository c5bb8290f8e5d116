"""Device time by pass: every dispatch once, in order, under its shader's name."""

from __future__ import annotations

from typing import Any

import pytest

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.profile import Profile


def run(device: Device, profile: Profile, groups: list[int]) -> None:
    names = ("length", "values", "block_sums")
    arrays = {name: DeviceArray.empty(device, name, (64,), "uint32") for name in names}
    with Commands(device, profile) as commands:
        for count in groups:
            commands.dispatch(Kernel.get(device, "scan_reduce", SCAN_LANES=64), count, **arrays)


@pytest.fixture
def profile(device: Device) -> Profile:
    if "timestamp-query" not in device.features:
        pytest.skip("the adapter has no timestamps")
    return Profile(device, capacity=4)


@pytest.mark.kernels
def test_dispatches_are_timed_in_order_over_several_submissions(device: Device, profile: Profile) -> None:
    run(device, profile, [1, 1])
    run(device, profile, [50_000])
    run(device, profile, [])
    names, times = zip(*profile.read(), strict=True)
    assert names == ("scan_reduce",) * 3
    assert min(times) > 0.0


@pytest.mark.kernels
def test_dispatches_are_timed_beyond_a_flush(device: Device, profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "watchdog", True)
    dispatch = Commands.dispatch

    def flushed(self: Commands, *given: Any, **arrays: DeviceArray) -> None:
        dispatch(self, *given, **arrays)
        self.flush()

    monkeypatch.setattr(Commands, "dispatch", flushed)
    run(device, profile, [1, 50_000, 1])
    names, times = zip(*profile.read(), strict=True)
    assert names == ("scan_reduce",) * 3
    assert min(times) > 0.0


def test_a_full_profile_says_so(device: Device, profile: Profile) -> None:
    with pytest.raises(RuntimeError, match="Profile of 4 dispatches is full"):
        run(device, profile, [1] * 5)


def test_a_device_without_timestamps_says_so(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "features", device.features - {"timestamp-query"})
    with pytest.raises(RuntimeError, match="no timestamps"):
        Profile(device)
