"""Buffers on the device, pools of them, arrays in them, and the textures that tables are read through."""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.driver_errors import translated_errors
from lapgs_wgpu.gpu.native import Mapping, TextureCopies
from lapgs_wgpu.gpu.shader import TABLE_TYPES, TABLE_WIDTH

_ITEM_BYTES = {"float32": 4, "uint32": 4, "uint8": 1, "uint64": 8}
_STORAGE = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
_MOST_ROWS = 8192  # of a texture, by WebGPU's default limits
_MOST_CONSTANTS = 1024  # of a pool: those of earlier sizes accumulate
_numbers = itertools.count()


@dataclass
class _Texture:
    texture: Any
    view: Any
    rows: int
    place: tuple[int, int] | None = None  # offset and size of what is copied
    copies: TextureCopies | None = None
    version: int = -1  # of what was copied


class Buffer:
    """A storage or uniform buffer of `nbytes` (rounded up to 16), initially zero.

    It is written through the queue, and read through a staging buffer of the same size, which is kept.
    """

    def __init__(self, device: Device, nbytes: int, label: str) -> None:
        self.device = device
        self.label = label
        self.nbytes = max(16, (nbytes + 15) & ~15)
        if self.nbytes > device.limits["max-buffer-size"]:
            limit = device.limits["max-buffer-size"]
            raise DeviceMemoryError(f"buffer {label!r} needs {self.nbytes} bytes, and one of this device holds {limit}")
        self.wgpu_buffer = self._create(_STORAGE)
        self.number = next(_numbers)  # unique, also among freed buffers
        self.version = 0  # number of writes: tells whether a texture made from the buffer is out of date
        self._textures: dict[str, _Texture] = {}

    @functools.cached_property
    def download(self) -> Any:
        """The staging buffer for reading."""
        return self._create(wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST)

    def _create(self, usage: int) -> Any:
        with translated_errors(self.device, f"buffer {self.label!r}", self.nbytes):
            return self.device.wgpu_device.create_buffer(label=self.label, size=self.nbytes, usage=usage)

    def write(self, array: NDArray[Any], offset: int = 0) -> None:
        """Copy an array into the buffer, `offset` bytes (a multiple of 8) from its start."""
        data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        if offset + data.nbytes > self.nbytes:
            raise ValueError(f"{self.label}: {offset + data.nbytes} bytes do not fit into {self.nbytes}")
        if data.nbytes == 0:
            return
        self.version += 1
        with translated_errors(self.device, f"what is written to buffer {self.label!r}", data.nbytes):
            self.device.queue.write_buffer(self.wgpu_buffer, offset, data)

    def texture(self, texel_format: str, offset: int, size: int) -> tuple[Any, TextureCopies | None]:
        """Return a view of a texture that holds `size` bytes from `offset` on, in rows of TABLE_WIDTH texels.

        If the buffer has changed, also the copies that have to be made first.
        """
        texel = next(nbytes for name, nbytes, _ in TABLE_TYPES.values() if name == texel_format)
        count = size // texel
        rows = -(-count // TABLE_WIDTH)
        held = self._textures.get(texel_format)
        if held is None or held.rows < rows:
            # Mesa's software driver compiles a shader anew for each combination of textures whose heights are and are
            # not powers of two.
            if rows.bit_count() == 1 and rows < _MOST_ROWS:
                rows = max(3, rows + 1)
            with translated_errors(self.device, f"the texture of buffer {self.label!r}", rows * TABLE_WIDTH * texel):
                texture = self.device.wgpu_device.create_texture(
                    label=self.label,
                    size=(TABLE_WIDTH, rows, 1),
                    format=texel_format,
                    usage=wgpu.TextureUsage.STORAGE_BINDING | wgpu.TextureUsage.COPY_DST,
                )
            held = self._textures[texel_format] = _Texture(texture, texture.create_view(), rows)
        if held.place != (offset, size):
            held.place, held.version = (offset, size), -1
            held.copies = TextureCopies(self.wgpu_buffer, offset, held.texture, TABLE_WIDTH, texel, count)
        if held.version == self.version:
            return held.view, None
        held.version = self.version
        return held.view, held.copies


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
        row_bytes = math.prod(self.shape[1:]) * _ITEM_BYTES[self.dtype]
        return DeviceArray(self.buffer, (count, *self.shape[1:]), self.dtype, self.offset + first * row_bytes)

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


class BufferPool:
    """Buffers by name, which grow and never shrink: a training step allocates nothing in steady state.

    Its owner asks it for arrays, and the passes that it hands the pool to.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: dict[str, Buffer] = {}
        self._constants: dict[bytes, DeviceArray] = {}
        self._written: dict[str, bytes] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: str = "float32") -> DeviceArray:
        """Return an array at the start of the named buffer, whose content is lost if it has to grow."""
        buffer = self._buffers.get(name)
        nbytes = math.prod(shape) * _ITEM_BYTES[dtype]
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
