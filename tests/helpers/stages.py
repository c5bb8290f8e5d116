"""Looking between the passes of the rasteriser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lapgs_wgpu.gpu.buffer import Buffer
from lapgs_wgpu.gpu.kernel import Commands, Kernel

Copies = list[dict[str, Buffer]]


def capture(monkeypatch: pytest.MonkeyPatch, pass_name: str, *names: str) -> Copies:
    """Copies of the named buffers, as they are right after each dispatch of a pass, for draws from now on.

    The copies are made inside the submission, since later passes use some buffers as scratch.
    """
    copies: Copies = []
    dispatch_grid = Commands.dispatch_grid

    def spy(self: Commands, kernel: Kernel, groups: tuple[int, int], **buffers: Any) -> None:
        dispatch_grid(self, kernel, groups, **buffers)
        if kernel.name != pass_name:
            return
        self._end_pass()
        made = {}
        for name in names:
            source, offset, size = kernel.parts(buffers)[name]
            made[name] = Buffer(self.device, size, f"copy of {name}")
            self._encoder.copy_buffer_to_buffer(source.wgpu_buffer, offset, made[name].wgpu_buffer, 0, size)
        copies.append(made)

    monkeypatch.setattr(Commands, "dispatch_grid", spy)
    return copies


def all_of(buffer: Buffer, dtype: str = "uint32") -> NDArray[Any]:
    """The whole content of a buffer."""
    return buffer.read(dtype, (buffer.nbytes // np.dtype(dtype).itemsize,))


def watch(monkeypatch: pytest.MonkeyPatch, see: Callable[[str], None]) -> None:
    """Calls `see` with the name of each pass that is dispatched from now on."""
    dispatch_grid = Commands.dispatch_grid

    def spy(self: Commands, kernel: Kernel, groups: tuple[int, int], **buffers: Any) -> None:
        see(kernel.name)
        dispatch_grid(self, kernel, groups, **buffers)

    monkeypatch.setattr(Commands, "dispatch_grid", spy)
