"""Ground truth that stays on the device."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device

LEFT_OUT = (1, 0, 0, 0)  # RGBA of a pixel that the losses leave out


class TruthCache:
    """Pictures on the device in 8 bits, the most recently used first to stay, within a bound in bytes.

    max_bytes: bound on what is kept, 4 bytes a pixel; a picture larger than this is handed out and not kept.
    """

    def __init__(self, device: Device, max_bytes: int) -> None:
        self.device, self.max_bytes = device, max_bytes
        self._held: OrderedDict[Hashable, DeviceArray] = OrderedDict()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._held

    @property
    def used_bytes(self) -> int:
        """Bytes kept at present."""
        return sum(array.buffer.nbytes for array in self._held.values())

    def clear(self) -> None:
        """Keep none of them any more."""
        self._held.clear()

    def get(self, key: Hashable, load: Callable[[], NDArray[np.uint8]]) -> DeviceArray:
        """The picture of this key; `load` is called where it is not held: (H, W, 3) RGB or (H, W, 4) straight RGBA."""
        array = self._held.pop(key, None) or upload_rgba(self.device, load())
        if array.buffer.nbytes <= self.max_bytes:
            while self.used_bytes + array.buffer.nbytes > self.max_bytes:
                self._held.popitem(last=False)
            self._held[key] = array
        return array


def without(pixels: NDArray[np.uint8], ignored: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """A picture (H, W, 3) or (H, W, 4) with the pixels marked that the loss leaves out: (H, W) bool, None for none.

    A transparent pixel has no color, whatever the file says; with red 1 it is left out
    (shaders/common/on_background.wgsl), with 0 it counts.
    """
    if ignored is None and pixels.shape[2] == 3:
        return pixels
    rgba = _rgba(pixels)
    rgba[rgba[..., 3] == 0] = 0
    if ignored is not None:
        rgba[ignored] = LEFT_OUT
    return rgba


def upload_rgba(device: Device, pixels: NDArray[np.uint8]) -> DeviceArray:
    """(H, W) uint32 on the device, red in the lowest byte, of (H, W, 3) RGB or (H, W, 4) straight RGBA in 8 bits."""
    return DeviceArray.upload(device, "truth", _rgba(pixels).view(np.uint32)[..., 0])


def _rgba(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A new array (H, W, 4), opaque where the pixels (H, W, 3 or 4) have no alpha."""
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., : pixels.shape[2]] = pixels
    return rgba
