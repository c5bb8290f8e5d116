"""Small results that are read some time after they were submitted, without a wait for what was submitted since."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.native import Mapping
from lapgs_wgpu.gpu.wgpu_errors import check_not_lost, translated_errors


class Later:
    """Copies of some arrays, which commands make, and which `read` waits for once they were submitted.

    The arrays' sizes are multiples of 4 bytes. ring: buffers that earlier ones have read, and that are used again.
    """

    def __init__(self, commands: Commands, arrays: Sequence[DeviceArray], ring: list[Any]) -> None:
        self._device, self._arrays, self._ring = commands.device, arrays, ring
        *self._starts, self._nbytes = itertools.accumulate((array.nbytes for array in arrays), initial=0)
        self._buffer = next((buffer for buffer in ring if buffer.size >= self._nbytes), None)
        if self._buffer is not None:
            ring.remove(self._buffer)
        else:
            with translated_errors(self._device, "what is read later", self._nbytes):
                self._buffer = self._device.wgpu_device.create_buffer(
                    label="later", size=self._nbytes, usage=wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
                )
        for array, start in zip(arrays, self._starts, strict=True):
            commands.copy_out(array, self._buffer, start)
        self._mapping: Mapping

    def submitted(self) -> None:
        """Ask for the copies, after the submission that makes them."""
        with translated_errors(self._device, "what is read later"):
            self._mapping = Mapping(self._device, self._buffer, 0, self._nbytes)

    def read(self) -> list[NDArray[Any]]:
        """The arrays' contents. Raises DeviceError where the device does not give them."""
        with translated_errors(self._device, "what is read later"):
            self._mapping.wait()
            check_not_lost(self._device)  # the native library would end the process
            with self._mapping as mapped:
                parts = np.split(mapped.copy(), self._starts[1:])
        self._ring.append(self._buffer)
        return [part.view(array.dtype).reshape(array.shape) for part, array in zip(parts, self._arrays, strict=True)]
