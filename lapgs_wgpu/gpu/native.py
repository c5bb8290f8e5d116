"""wgpu's native library: the calls that a training step makes by the hundred, straight to it.

wgpu-py takes some 20 microseconds for each such call, and maps buffers by way of a thread that polls. Objects are
wgpu-py's own, which keep them alive; errors are raised as wgpu-py raises them.
"""

import itertools
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from wgpu.backends.wgpu_native import ffi, lib

from lapgs_wgpu.errors import DeviceLostError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.driver_errors import raising

# The longest wait for a graphics card, seconds: macOS kills work long before, and the library tells nobody.
LONGEST_WAIT = 60.0
_numbers = itertools.count(1)  # of mappings
_statuses: dict[int, int] = {}  # of mappings that are done, by number


@ffi.callback("void(WGPUMapAsyncStatus, WGPUStringView, void *, void *)")
def _mapped(status: int, _message: Any, number: Any, _second: Any) -> None:
    """Called in any thread that polls, which may not be the one that waits."""
    _statuses[int(ffi.cast("uintptr_t", number))] = status


class Mapping:
    """The bytes of a staging buffer, asked for now, and there once the device has done what uses them.

    `with` waits and gives them in place, until it ends. Threads may map at the same time. offset: a multiple of 8.
    nbytes: a multiple of 4. Raises wgpu.GPUError, or RuntimeError where the device refuses.
    """

    def __init__(self, device: Device, buffer: Any, offset: int, nbytes: int) -> None:
        self._device, self._buffer, self._place = device, buffer, (offset, nbytes)
        self._number, info = next(_numbers), ffi.new("WGPUBufferMapCallbackInfo *")  # which the library copies
        info.mode, info.callback = lib.WGPUCallbackMode_AllowProcessEvents, _mapped
        info.userdata1 = ffi.cast("void *", self._number)
        with raising("wgpuBufferMapAsync"):
            lib.wgpuBufferMapAsync(buffer._internal, lib.WGPUMapMode_Read, offset, nbytes, info[0])

    def wait(self) -> None:
        """Wait for the bytes. Raises DeviceLostError where none come.

        It polls, since the library would wait for all that was submitted, on Metal for ever once macOS has killed a
        command buffer (gfx-rs/wgpu#9531).
        """
        device, begun = self._device, time.monotonic()
        while self._number not in _statuses:
            lib.wgpuDevicePoll(device.wgpu_device._internal, False, ffi.NULL)
            if self._number in _statuses:
                break
            waited = time.monotonic() - begun
            if device.watchdog and waited > LONGEST_WAIT:
                raise DeviceLostError(
                    f"{device.info.name} has not answered for {LONGEST_WAIT:.0f} seconds: its driver has ended the work"
                )
            time.sleep(min(1e-3, waited / 10))

    def __enter__(self) -> NDArray[np.uint8]:
        with raising("wgpuDevicePoll"):
            self.wait()
        status = _statuses.pop(self._number)
        if status != lib.WGPUMapAsyncStatus_Success:
            raise RuntimeError(f"Could not map buffer ({status}).")
        start = lib.wgpuBufferGetMappedRange(self._buffer._internal, *self._place)
        return np.frombuffer(ffi.buffer(start, self._place[1]), np.uint8)

    def __exit__(self, *error: object) -> None:
        lib.wgpuBufferUnmap(self._buffer._internal)


# A command: ("dispatch", kernel, bind group, columns, rows), ("clear", buffer, offset, bytes), ("copy", source, offset,
# target, offset, bytes) or ("texture", copies, buffer).
Command = tuple[Any, ...]


def play(encoder: Any, commands: Iterable[Command]) -> None:
    """Record commands in wgpu's encoder, within `raising`. Dispatches with nothing between share a compute pass."""
    native, open_pass, last = encoder._internal, None, None
    pipeline_of, group_of = lib.wgpuComputePassEncoderSetPipeline, lib.wgpuComputePassEncoderSetBindGroup
    dispatch, nothing = lib.wgpuComputePassEncoderDispatchWorkgroups, ffi.NULL
    for what, *values in (*commands, ("end",)):
        if what == "dispatch":
            kernel, group, columns, rows = values
            if open_pass is None:
                open_pass, last = lib.wgpuCommandEncoderBeginComputePass(native, nothing), None
            if kernel is not last:
                pipeline_of(open_pass, kernel.pipeline._internal)
                last = kernel
            group_of(open_pass, 0, group._internal, 0, nothing)
            dispatch(open_pass, columns, rows, 1)
            continue
        if open_pass is not None:
            lib.wgpuComputePassEncoderEnd(open_pass)
            lib.wgpuComputePassEncoderRelease(open_pass)
            open_pass = None
        if what == "clear":
            buffer, offset, nbytes = values
            lib.wgpuCommandEncoderClearBuffer(native, buffer._internal, offset, nbytes)
        elif what == "copy":
            source, offset, target, to, nbytes = values
            lib.wgpuCommandEncoderCopyBufferToBuffer(native, source._internal, offset, target._internal, to, nbytes)
        elif what == "texture":
            for part in values[0].parts:
                lib.wgpuCommandEncoderCopyBufferToTexture(native, *part)


class TextureCopies:
    """Descriptors of the copies of `texels` from a buffer offset to a texture: full rows, then the rest of one."""

    def __init__(self, buffer: Any, offset: int, texture: Any, width: int, texel_bytes: int, texels: int) -> None:
        pitch = width * texel_bytes
        full, rest = divmod(texels, width)
        self.parts, self._kept = [], (buffer, texture)  # what the descriptors name lives as long
        for row, columns, rows in ((0, width, full), (full, rest, 1)):
            if columns and rows:
                source, target = ffi.new("WGPUTexelCopyBufferInfo *"), ffi.new("WGPUTexelCopyTextureInfo *")
                source.buffer, source.layout.offset = buffer._internal, offset + row * pitch
                source.layout.bytesPerRow, source.layout.rowsPerImage = pitch, rows
                target.texture, target.origin.y, target.aspect = texture._internal, row, lib.WGPUTextureAspect_All
                size = ffi.new("WGPUExtent3D *", (columns, rows, 1))
                self.parts.append((source, target, size))
