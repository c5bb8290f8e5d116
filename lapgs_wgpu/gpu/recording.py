"""Commands that are recorded once and submitted again, with uniforms of their own: a dispatch then takes its host a few
microseconds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.native import Command

_APART = 256  # bytes: bindings of uniforms may begin at its multiples
_TOGETHER = 128  # uniforms in a buffer


class _Uniforms:
    def __init__(self, device: Device) -> None:
        self.array = DeviceArray.empty(device, "uniforms", (_TOGETHER * _APART,), "uint8")
        self._content, self._used = bytearray(_TOGETHER * _APART), 0

    def place(self, nbytes: int) -> DeviceArray | None:
        """Room for a uniform; None where there is none."""
        first, end = self._used, self._used + -(-nbytes // _APART) * _APART
        if end > len(self._content):
            return None
        self._used = end
        return self.array.rows(first, nbytes)

    def set(self, place: DeviceArray, content: bytes) -> None:
        """Change a uniform."""
        self._content[place.offset : place.offset + len(content)] = content

    def upload(self) -> None:
        """Write them to the device."""
        self.array.rows(0, self._used).write(np.frombuffer(self._content, np.uint8, self._used))


class Recording:
    """What `Commands` did, and the uniforms of it, of which those that vary are written anew before it is done again.

    It holds as long as no array that it uses was made anew (`Device.generation`).
    """

    def __init__(self, device: Device) -> None:
        self._device, self._generation = device, device.generation
        self.commands: list[Command] = []
        self._fixed: dict[bytes, DeviceArray] = {}
        self._varying: dict[object, tuple[DeviceArray, Callable[[], bytes]]] = {}
        self._buffers = [_Uniforms(device)]  # the first one is for what varies

    def finish(self, commands: list[Command]) -> None:
        """All was recorded."""
        self.commands, self._generation = commands, self._device.generation
        for uniforms in self._buffers:
            uniforms.upload()

    @property
    def holds(self) -> bool:
        """Whether it may be done again."""
        return self._generation == self._device.generation

    def constant(self, content: bytes) -> DeviceArray:
        """A uniform that stays as it is."""
        if content not in self._fixed:
            place = self._buffers[-1].place(len(content)) if len(self._buffers) > 1 else None
            if place is None:
                self._buffers.append(_Uniforms(self._device))
                place = self._buffers[-1].place(len(content))
                assert place is not None
            self._buffers[-1].set(place, content)
            self._fixed[content] = place
        return self._fixed[content]

    def varying(self, key: object, write: Callable[[], bytes]) -> DeviceArray:
        """A uniform that `write` gives anew before each replay; the one that it was where the key is known."""
        if key not in self._varying:
            content = write()
            place = self._buffers[0].place(len(content))
            if place is None:
                raise ValueError(f"more than {_TOGETHER} uniforms of a recording vary")
            self._buffers[0].set(place, content)
            self._varying[key] = place, write
        return self._varying[key][0]

    def renew(self) -> None:
        """Write what varies."""
        for place, write in self._varying.values():
            self._buffers[0].set(place, write())
        self._buffers[0].upload()
