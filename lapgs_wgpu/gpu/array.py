"""Arrays on the device: a part of a buffer with a dtype and a shape."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from lapgs_wgpu.gpu.buffer import Buffer
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.native import Mapping
from lapgs_wgpu.gpu.wgpu_errors import translated_errors

_ITEM_BYTES = {"float32": 4, "uint32": 4, "uint8": 1, "uint64": 8}


@dataclass(frozen=True, eq=False)
class DeviceArray:
    """A contiguous array in a buffer.

    dtype: float32, uint32, uint8 or uint64. offset: in bytes, from the buffer's start.
    """

    buffer: Buffer
    shape: tuple[int, ...]
    dtype: str = "float32"
    offset: int = 0
    nbytes: int = field(init=False)  # of the elements
    bound_bytes: int = field(init=False)  # what a kernel sees: the array, rounded up to 16 bytes

    def __post_init__(self) -> None:
        nbytes = math.prod(self.shape) * _ITEM_BYTES[self.dtype]
        object.__setattr__(self, "nbytes", nbytes)
        object.__setattr__(self, "bound_bytes", max(16, (nbytes + 15) & ~15))

    @staticmethod
    def empty(device: Device, label: str, shape: tuple[int, ...], dtype: str = "float32") -> "DeviceArray":
        """Return an array of zeros in a buffer of its own."""
        return DeviceArray(Buffer(device, math.prod(shape) * _ITEM_BYTES[dtype], label), shape, dtype)

    @staticmethod
    def upload(device: Device, label: str, values: NDArray[Any]) -> "DeviceArray":
        """Return a copy of `values`, with their shape and dtype, in a buffer of its own."""
        array = DeviceArray.empty(device, label, values.shape, values.dtype.name)
        array.write(values)
        return array

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def key(self) -> tuple[int, int, int, str]:
        """Equal for arrays that are the same to a kernel."""
        return self.buffer.number, self.offset, self.bound_bytes, self.dtype

    @property
    def resource(self) -> dict[str, Any]:
        """The resource that wgpu binds."""
        return {"buffer": self.buffer.wgpu_buffer, "offset": self.offset, "size": self.bound_bytes}

    def rows(self, first: int, count: int) -> "DeviceArray":
        """Rows first to first + count; to be bound, they must begin at a multiple of 256 bytes."""
        row = math.prod(self.shape[1:])
        return DeviceArray(
            self.buffer, (count, *self.shape[1:]), self.dtype, self.offset + first * row * _ITEM_BYTES[self.dtype]
        )

    def write(self, values: NDArray[Any]) -> None:
        """Copy values of the array's dtype and shape to the device. Raises ValueError for others."""
        if values.dtype.name != self.dtype or values.shape != self.shape:
            raise ValueError(f"{self.buffer.label}: {values.dtype} {values.shape} is not {self.dtype} {self.shape}")
        self.buffer.write(values, self.offset)

    def read(self) -> NDArray[Any]:
        """Return a copy of the array on the host. Waits for the device."""
        return read_all([self])[0]


def read_all(arrays: Sequence[DeviceArray]) -> list[NDArray[Any]]:
    """Read several arrays with one wait. Their offsets must be multiples of 8 bytes."""
    if not arrays:
        return []
    device = arrays[0].buffer.device
    places = [(array.offset, max(8, (array.nbytes + 7) & ~7)) for array in arrays]
    with translated_errors(device, "what is read back"):
        encoder = device.wgpu_device.create_command_encoder()
        for array, (offset, size) in zip(arrays, places, strict=True):
            encoder.copy_buffer_to_buffer(array.buffer.wgpu_buffer, offset, array.buffer.download, offset, size)
        device.queue.submit([encoder.finish()])
    out = []
    for array, (offset, size) in zip(arrays, places, strict=True):
        with (
            translated_errors(device, f"what is read from buffer {array.buffer.label!r}", array.nbytes),
            Mapping(device, array.buffer.download, offset, size) as content,
        ):
            out.append(content[: array.nbytes].copy().view(array.dtype).reshape(array.shape))
    return out
