"""Named arrays that a module keeps from call to call."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .array import DeviceArray
from .buffer import Buffer
from .device import Device


class BufferPool:
    """Buffers by name that grow and never shrink, so that a training step allocates nothing in steady state.

    A name means one thing, in the module that owns the pool; other modules get its arrays as arguments or results.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: dict[str, Buffer] = {}
        self._constants: dict[str, bytes] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: str = "float32") -> DeviceArray:
        """An array at the start of the buffer of this name; its content is lost when the buffer has to grow."""
        buffer = self._buffers.get(name)
        nbytes = math.prod(shape) * np.dtype(dtype).itemsize
        if buffer is None or buffer.nbytes < nbytes:
            buffer = self._buffers[name] = Buffer(self.device, nbytes, name)
        return DeviceArray(buffer, shape, dtype)

    def upload(self, name: str, values: NDArray[Any]) -> DeviceArray:
        """A copy of `values`, with their shape and dtype, in the buffer of this name."""
        array = self.array(name, values.shape, values.dtype.name)
        array.write(values)
        return array

    def constant(self, name: str, content: bytes) -> DeviceArray:
        """A small array with this content, written only when the content changes.

        It must not change between the recording of a command that reads it and that command's submission.
        """
        array = self.array(f"constant {name}", (len(content),), "uint8")
        if self._constants.get(name) != content:
            array.write(np.frombuffer(content, np.uint8))
            self._constants[name] = content
        return array

    @property
    def nbytes(self) -> int:
        """Bytes held by all buffers of the pool."""
        return sum(buffer.nbytes for buffer in self._buffers.values())
