"""Small results that are read some time after they were submitted, without a wait for what was submitted since."""

from collections.abc import Sequence
from typing import Any

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
        self._device, self._arrays, self._nbytes = commands.device, arrays, sum(array.nbytes for array in arrays)
        self._ring, large_enough = ring, [buffer for buffer in ring if buffer.size >= self._nbytes]
        if large_enough:
            self._buffer = large_enough[0]
            ring.remove(self._buffer)
        else:
            with translated_errors(self._device, "what is read later", self._nbytes):
                self._buffer = self._device.wgpu_device.create_buffer(
                    label="later", size=self._nbytes, usage=wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
                )
        at = 0
        for array in arrays:
            commands.copy_out(array, self._buffer, at)
            at += array.nbytes
        self._mapping: Mapping

    def submitted(self) -> None:
        """Ask for the copies, after the submission that makes them."""
        with translated_errors(self._device, "what is read later"):
            self._mapping = Mapping(self._device, self._buffer, 0, self._nbytes)

    def read(self) -> list[NDArray[Any]]:
        """The arrays' contents. Raises DeviceError where the device does not give them."""
        found, at = [], 0
        with translated_errors(self._device, "what is read later"):
            self._mapping.wait()
            check_not_lost(self._device)  # the native library would end the process
            with self._mapping as content:
                for array in self._arrays:
                    values = content[at : at + array.nbytes].copy()
                    found.append(values.view(array.dtype).reshape(array.shape))
                    at += array.nbytes
        self._ring.append(self._buffer)
        return found
