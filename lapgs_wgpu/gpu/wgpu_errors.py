"""Translates wgpu's errors for exhausted memory and lost devices into errors with texts for users.

wgpu-py 0.32 raises both at the call: exhausted memory as a validation error, a lost device as a validation error or,
when mapping a buffer, as an AttributeError. A submission that the native library refuses ends the process instead.
Hence commands are finished right before their submission, where a lost device raises an error in time, and sizes are
checked before buffers are created.
"""

from __future__ import annotations

from types import TracebackType
from typing import Any

import wgpu

from lapgs_wgpu.errors import DeviceError, DeviceLostError, DeviceMemoryError
from lapgs_wgpu.gpu.device import Device

_NO_MEMORY = "Not enough memory left"
_LOST = "device is lost"


class TranslatedErrors:
    """A context that turns exhausted memory and a lost device into a DeviceError; other errors pass unchanged.

    what: purpose of the memory. nbytes: its size, 0 if unknown.
    """

    def __init__(self, device: Device, what: str, nbytes: int = 0) -> None:
        self._device, self._what, self._nbytes = device, what, nbytes

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if not isinstance(error, wgpu.GPUError | RuntimeError | AttributeError) or isinstance(error, DeviceError):
            return
        name, text = self._device.info.name, str(error)
        if isinstance(error, wgpu.GPUOutOfMemoryError) or _NO_MEMORY in text:
            size = f" of {self._nbytes / 1e6:.0f} MB" if self._nbytes else ""
            raise DeviceMemoryError(
                f"{name} has no memory left for {self._what}{size}, fewer Gaussians or smaller pictures need less"
            ) from error
        if _LOST in text or is_lost(self._device.wgpu_device):
            raise DeviceLostError(f"{name} was lost, because its driver gave up or it was removed") from error


def is_lost(native: Any) -> bool:
    """Return whether wgpu's device is lost."""
    try:
        native.create_buffer(size=16, usage=wgpu.BufferUsage.COPY_DST)
    except wgpu.GPUError as error:
        return _LOST in str(error)
    return False
