"""Small results that are read some time after they were submitted, without a wait for what was submitted since."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.errors import DeviceLostError
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.native import READ, Mapping
from lapgs_wgpu.gpu.wgpu_errors import TranslatedErrors, is_lost


class Later:
    """Copies of some arrays, which `Ring.record` makes, and which `read` waits for once they were submitted."""

    def __init__(self, ring: Ring, buffer: Any, arrays: Sequence[DeviceArray]) -> None:
        self._ring, self._buffer, self._arrays = ring, buffer, list(arrays)
        self._mapping: Mapping

    def submitted(self) -> None:
        """Ask for the copies, after the submission that makes them."""
        with TranslatedErrors(self._ring.device, "what is read later"):
            self._mapping = Mapping(self._ring.device, self._buffer, READ, 0, self._ring.nbytes)

    def read(self) -> list[NDArray[Any]]:
        """The arrays' contents. Raises DeviceError where the device does not give them."""
        device, found, at = self._ring.device, [], 0
        with TranslatedErrors(device, "what is read later"):
            self._mapping.wait(alone=True)
            if is_lost(device.wgpu_device):  # the native library would end the process
                raise DeviceLostError(f"{device.info.name} was lost, because its driver gave up or it was removed")
            with self._mapping as content:
                for array in self._arrays:
                    values = content[at : at + array.nbytes].copy()
                    found.append(values.view(array.dtype).reshape(array.shape))
                    at += array.nbytes
        self._ring.free.append(self._buffer)
        return found


class Ring:
    """Buffers of `nbytes` bytes for results that are read later, used again and again."""

    def __init__(self, device: Device, nbytes: int) -> None:
        self.device, self.nbytes = device, nbytes
        self.free: list[Any] = []

    def record(self, commands: Commands, arrays: Sequence[DeviceArray]) -> Later:
        """Record copies of arrays, whose sizes are multiples of 4 bytes."""
        if self.free:
            buffer = self.free.pop()
        else:
            usage = wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
            with TranslatedErrors(self.device, "what is read later", self.nbytes):
                buffer = self.device.wgpu_device.create_buffer(label="later", size=self.nbytes, usage=usage)
        at = 0
        for array in arrays:
            commands.copy_out(array, buffer, at)
            at += array.nbytes
        if at > self.nbytes:
            raise ValueError(f"{at} bytes are to be read later, and the buffers hold {self.nbytes}")
        return Later(self, buffer, arrays)
