"""Buffers on the device, their uploads, and the textures made from them."""

import functools
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.native import TextureCopies
from lapgs_wgpu.gpu.shader import TABLE_TYPES, TABLE_WIDTH
from lapgs_wgpu.gpu.wgpu_errors import translated_errors

_STORAGE = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
_MOST_ROWS = 8192  # of a texture, by WebGPU's default limits
_numbers = itertools.count()


def _height(rows: int) -> int:
    """Return the height of a texture with room for so many rows: no power of two, unless no more are allowed.

    Mesa's software driver compiles a shader anew for each combination of textures whose sizes are and are not powers of
    two.
    """
    if rows.bit_count() > 1 or rows >= _MOST_ROWS:
        return rows
    return max(3, rows + 1)


@dataclass
class _Texture:
    texture: Any
    view: Any
    rows: int
    place: tuple[int, int] = (0, 0)  # offset and size of what is copied
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
            rows = _height(rows)
            with translated_errors(self.device, f"the texture of buffer {self.label!r}", rows * TABLE_WIDTH * texel):
                texture = self.device.wgpu_device.create_texture(
                    label=self.label,
                    size=(TABLE_WIDTH, rows, 1),
                    format=texel_format,
                    usage=wgpu.TextureUsage.STORAGE_BINDING | wgpu.TextureUsage.COPY_DST,
                )
            held = self._textures[texel_format] = _Texture(texture, texture.create_view(), rows)
        if held.copies is None or held.place != (offset, size):
            held.place = (offset, size)
            held.copies = TextureCopies(self.wgpu_buffer, offset, held.texture, TABLE_WIDTH, texel, count)
            held.version = -1
        if held.version == self.version:
            return held.view, None
        held.version = self.version
        return held.view, held.copies
