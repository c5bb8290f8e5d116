"""Buffers that a module reuses from call to call."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import Buffer, DeviceArray
from lapgs_wgpu.gpu.device import Device

_MOST_CONSTANTS = 1024  # of a pool: those of earlier sizes accumulate


class BufferPool:
    """Buffers by name, which grow and never shrink: a training step allocates nothing in steady state.

    Only the object that owns the pool asks it for arrays; it passes them to others as arguments and results.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: dict[str, Buffer] = {}
        self._constants: dict[bytes, DeviceArray] = {}
        self._written: dict[str, bytes] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: str = "float32") -> DeviceArray:
        """Return an array at the start of the named buffer, whose content is lost if it has to grow."""
        buffer = self._buffers.get(name)
        nbytes = math.prod(shape) * np.dtype(dtype).itemsize
        if buffer is None or buffer.nbytes < nbytes:
            self.device.generation += 1
            buffer = self._buffers[name] = Buffer(self.device, nbytes, name)
        return DeviceArray(buffer, shape, dtype)

    def upload(self, name: str, values: NDArray[Any]) -> DeviceArray:
        """Return a copy of `values`, with their shape and dtype, in the buffer of this name."""
        array = self.array(name, values.shape, values.dtype.name)
        array.write(values)
        return array

    def constant(self, content: bytes) -> DeviceArray:
        """Return a small array with this content, the same one each time."""
        if content not in self._constants:
            if len(self._constants) >= _MOST_CONSTANTS:
                self._constants.clear()
            self._constants[content] = DeviceArray.upload(self.device, "constant", np.frombuffer(content, np.uint8))
        return self._constants[content]

    def varying(self, name: str, write: Callable[[], bytes]) -> DeviceArray:
        """Return a small array with the content that `write` gives, which is written over in the next call.

        The content must not change between recording and submission of a command that reads it; replays of a recording
        ask for it anew.
        """
        if self.device.recording is not None:
            return self.device.recording.varying((self, name), write)
        content = write()
        array = self.array(f"varying {name}", (len(content),), "uint8")
        if self._written.get(name) != content:
            array.write(np.frombuffer(content, np.uint8))
            self._written[name] = content
        return array

    @property
    def nbytes(self) -> int:
        """Bytes of all buffers."""
        return sum(buffer.nbytes for buffer in self._buffers.values())
