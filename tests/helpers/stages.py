"""Looking between the passes of the rasterizer."""

from collections.abc import Callable
from typing import Any

import pytest
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel

Copies = list[dict[str, DeviceArray]]


def capture(monkeypatch: pytest.MonkeyPatch, pass_name: str, *names: str) -> Copies:
    """Copies of the named arrays, as they are right after each dispatch of a pass, for draws from now on.

    The copies are made inside the submission, since later passes use some buffers as scratch.
    """
    copies: Copies = []
    dispatch_grid = Commands.dispatch_grid

    def spy(self: Commands, kernel: Kernel, groups: tuple[int, int] | DeviceArray, **arrays: DeviceArray) -> None:
        dispatch_grid(self, kernel, groups, **arrays)
        if kernel.name != pass_name:
            return
        made = {}
        for name in names:
            made[name] = DeviceArray.empty(self.device, f"copy of {name}", arrays[name].shape, arrays[name].dtype)
            self.copy(arrays[name], made[name])
        copies.append(made)

    monkeypatch.setattr(Commands, "dispatch_grid", spy)
    return copies


def all_of(array: DeviceArray) -> NDArray[Any]:
    return array.read().reshape(-1)


def watch(monkeypatch: pytest.MonkeyPatch, see: Callable[[str], None]) -> None:
    """Calls `see` with the name of each pass that is dispatched from now on."""
    dispatch_grid = Commands.dispatch_grid

    def spy(self: Commands, kernel: Kernel, groups: tuple[int, int] | DeviceArray, **buffers: Any) -> None:
        see(kernel.name)
        dispatch_grid(self, kernel, groups, **buffers)

    monkeypatch.setattr(Commands, "dispatch_grid", spy)
