"""Commands that are recorded once and submitted again: a dispatch then takes its host a few microseconds."""

from collections.abc import Callable

import numpy as np

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.native import Command

_APART = 256  # bytes: bindings of uniforms may begin at its multiples
_ROOM = 128 * _APART


class Recording:
    """What `Commands` did, and the uniforms of it that vary, which one write renews before it is done again.

    It holds as long as no array that it uses was made anew (`Device.generation`).
    """

    def __init__(self, device: Device) -> None:
        self._device, self._generation = device, device.generation
        self.commands: list[Command] = []
        self._uniforms, self._used = DeviceArray.empty(device, "uniforms", (_ROOM,), "uint8"), 0
        self._varying: dict[object, tuple[DeviceArray, Callable[[], bytes]]] = {}

    def finish(self, commands: list[Command]) -> None:
        """All was recorded."""
        self.commands, self._generation = commands, self._device.generation
        self.renew()

    @property
    def holds(self) -> bool:
        """Whether it may be done again."""
        return self._generation == self._device.generation

    def varying(self, key: object, write: Callable[[], bytes]) -> DeviceArray:
        """A uniform that `write` gives anew before each replay; the one that it was where the key is known."""
        if key not in self._varying:
            place = self._uniforms.rows(self._used, len(write()))
            self._used += -(-place.nbytes // _APART) * _APART
            if self._used > _ROOM:
                raise ValueError(f"the varying uniforms of a recording need more than {_ROOM} bytes")
            self._varying[key] = place, write
        return self._varying[key][0]

    def renew(self) -> None:
        """Write what varies."""
        content = np.zeros(self._used, np.uint8)
        for place, write in self._varying.values():
            content[place.offset : place.offset + place.nbytes] = np.frombuffer(write(), np.uint8)
        self._uniforms.rows(0, self._used).write(content)
