"""The calls that a training step makes by the hundred, straight to wgpu's native library.

wgpu-py takes some 20 microseconds for each such call, and maps buffers by way of a thread that polls. Objects are
wgpu-py's own, which keep them alive; errors are raised as wgpu-py raises them.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import wgpu
from numpy.typing import NDArray
from wgpu.backends.wgpu_native import ffi, lib
from wgpu.backends.wgpu_native._api import error_handler
from wgpu.backends.wgpu_native._helpers import ERROR_TYPES

from lapgs_wgpu.errors import DeviceLostError
from lapgs_wgpu.gpu.device import Device

READ, WRITE = lib.WGPUMapMode_Read, lib.WGPUMapMode_Write
# The longest wait for a device that is polled, seconds: macOS kills work long before, and the library tells nobody.
LONGEST_WAIT = 60.0
_SHORTEST_SLEEP, _LONGEST_SLEEP = 50e-6, 1e-3  # seconds between two polls
_numbers = itertools.count(1)  # of mappings
_statuses: dict[int, int] = {}  # of mappings that are done, by number


@contextmanager
def raising(what: str) -> Iterator[None]:
    """Raise what the library reports of the calls within, as a wgpu.GPUError."""
    error_handler.capture(what)
    try:
        yield
    finally:
        reported = error_handler.release(what)
    if reported is not None:
        kind, message = reported
        raise ERROR_TYPES.get(kind, wgpu.GPUError)(message)


@ffi.callback("void(WGPUMapAsyncStatus, WGPUStringView, void *, void *)")
def _mapped(status: int, _message: Any, number: Any, _second: Any) -> None:
    """Called in any thread that polls, which may not be the one that waits."""
    _statuses[int(ffi.cast("uintptr_t", number))] = status


class _Callback(threading.local):
    """Each thread's callback info for a mapping; the library copies it."""

    def __init__(self) -> None:
        self.info = ffi.new("WGPUBufferMapCallbackInfo *")
        self.info.mode = lib.WGPUCallbackMode_AllowProcessEvents
        self.info.callback = _mapped


_callback = _Callback()


@contextmanager
def mapping(device: Device, buffer: Any, mode: int, offset: int, nbytes: int) -> Iterator[NDArray[np.uint8]]:
    """The bytes of a buffer, in place, once the device has done what uses them. Threads may map at the same time.

    offset: a multiple of 8. nbytes: a multiple of 4. Raises wgpu.GPUError, or RuntimeError where the device refuses.
    """
    number, info = next(_numbers), _callback.info
    info.userdata1 = ffi.cast("void *", number)
    with raising("wgpuBufferMapAsync"):
        lib.wgpuBufferMapAsync(buffer._internal, mode, offset, nbytes, info[0])
        _wait_for(device, number)
    status = _statuses.pop(number)
    if status != lib.WGPUMapAsyncStatus_Success:
        raise RuntimeError(f"Could not map buffer ({status}).")
    try:
        start = lib.wgpuBufferGetMappedRange(buffer._internal, offset, nbytes)
        yield np.frombuffer(ffi.buffer(start, nbytes), np.uint8)
    finally:
        lib.wgpuBufferUnmap(buffer._internal)


def _wait_for(device: Device, number: int) -> None:
    """Poll the device until a mapping is done. Raises DeviceLostError where it never is."""
    native = device.wgpu_device._internal
    if device.waits:
        while number not in _statuses:
            lib.wgpuDevicePoll(native, True, ffi.NULL)
        return
    deadline, pause = time.monotonic() + LONGEST_WAIT, _SHORTEST_SLEEP
    while True:
        lib.wgpuDevicePoll(native, False, ffi.NULL)
        if number in _statuses:
            return
        if time.monotonic() > deadline:
            raise DeviceLostError(
                f"{device.info.name} has not answered for {LONGEST_WAIT:.0f} seconds: its driver has ended the work"
            )
        time.sleep(pause)
        pause = min(2 * pause, _LONGEST_SLEEP)


class Mapping:
    """The bytes of a buffer, once the device has done what uses them, without a wait."""

    def __init__(self, buffer: Any, nbytes: int) -> None:
        self._buffer, self._nbytes, self._number = buffer, nbytes, next(_numbers)
        info = _callback.info
        info.userdata1 = ffi.cast("void *", self._number)
        with raising("wgpuBufferMapAsync"):
            lib.wgpuBufferMapAsync(buffer._internal, READ, 0, nbytes, info[0])

    def poll(self, device: Device) -> bool:
        """Whether the bytes are there."""
        lib.wgpuDevicePoll(device.wgpu_device._internal, False, ffi.NULL)
        return self._number in _statuses

    def take(self) -> NDArray[np.uint8]:
        """A copy of the bytes, when they are there. Raises RuntimeError where the device refused them."""
        status = _statuses.pop(self._number)
        if status != lib.WGPUMapAsyncStatus_Success:
            raise RuntimeError(f"Could not map buffer ({status}).")
        start = lib.wgpuBufferGetMappedRange(self._buffer._internal, 0, self._nbytes)
        content = np.frombuffer(ffi.buffer(start, self._nbytes), np.uint8).copy()
        lib.wgpuBufferUnmap(self._buffer._internal)
        return content


class Encoder:
    """Records commands for one submission, within `raising`."""

    def __init__(self, device: Any) -> None:
        self.wgpu_encoder = device.create_command_encoder()
        self._encoder = self.wgpu_encoder._internal
        self._pass: Any = None
        self._timed: Any = None  # wgpu-py's pass, where it writes timestamps

    def begin_pass(self, timestamp_writes: dict[str, Any] | None = None) -> None:
        """Begin a compute pass, unless one is open; a new one in any case where it writes timestamps."""
        if timestamp_writes is not None:
            self.end_pass()
            self._timed = self.wgpu_encoder.begin_compute_pass(timestamp_writes=timestamp_writes)
            self._pass = self._timed._internal
        elif self._pass is None:
            self._pass = lib.wgpuCommandEncoderBeginComputePass(self._encoder, ffi.NULL)

    def end_pass(self) -> None:
        """End the compute pass that is open, if one is."""
        if self._pass is None:
            return
        lib.wgpuComputePassEncoderEnd(self._pass)
        if self._timed is None:
            lib.wgpuComputePassEncoderRelease(self._pass)
        self._pass = self._timed = None

    def dispatch(self, pipeline: Any, bind_group: Any, columns: int, rows: int) -> None:
        """Run a pipeline's workgroups on what is bound, within a pass."""
        lib.wgpuComputePassEncoderSetPipeline(self._pass, pipeline._internal)
        lib.wgpuComputePassEncoderSetBindGroup(self._pass, 0, bind_group._internal, 0, ffi.NULL)
        lib.wgpuComputePassEncoderDispatchWorkgroups(self._pass, columns, rows, 1)

    def replay(self, commands: list[tuple[Any, ...]]) -> None:
        """Do what a Recording holds."""
        pipeline_of, group_of = lib.wgpuComputePassEncoderSetPipeline, lib.wgpuComputePassEncoderSetBindGroup
        run, nothing = lib.wgpuComputePassEncoderDispatchWorkgroups, ffi.NULL
        for kind, *values in commands:
            if kind == "clear":
                self.end_pass()
                lib.wgpuCommandEncoderClearBuffer(self._encoder, *values)
                continue
            if self._pass is None:
                self.begin_pass()
            pipeline, group, columns, rows = values
            pipeline_of(self._pass, pipeline)
            group_of(self._pass, 0, group, 0, nothing)
            run(self._pass, columns, rows, 1)

    def clear(self, buffer: Any, offset: int, nbytes: int) -> None:
        """Set bytes of a buffer to zero."""
        self.end_pass()
        lib.wgpuCommandEncoderClearBuffer(self._encoder, buffer._internal, offset, nbytes)

    def copy(self, source: Any, source_offset: int, target: Any, target_offset: int, nbytes: int) -> None:
        """Copy bytes from buffer to buffer."""
        self.end_pass()
        lib.wgpuCommandEncoderCopyBufferToBuffer(
            self._encoder, source._internal, source_offset, target._internal, target_offset, nbytes
        )

    def copy_to_texture(self, copies: TextureCopies) -> None:
        """Copy from a buffer to a texture."""
        self.end_pass()
        for source, target, size in copies.parts:
            lib.wgpuCommandEncoderCopyBufferToTexture(self._encoder, source, target, size)

    def submit(self, queue: Any) -> None:
        """Have the device do what was recorded. Raises wgpu.GPUError where it refuses."""
        self.end_pass()
        queue.submit([self.wgpu_encoder.finish()])


class TextureCopies:
    """Descriptors of the copies of `texels` from a buffer offset to a texture: full rows, then the rest of one."""

    def __init__(self, buffer: Any, offset: int, texture: Any, width: int, texel_bytes: int, texels: int) -> None:
        pitch = width * texel_bytes
        full, rest = divmod(texels, width)
        self.parts = []
        for row, columns, rows in ((0, width, full), (full, rest, 1)):
            if columns and rows:
                source, target = ffi.new("WGPUTexelCopyBufferInfo *"), ffi.new("WGPUTexelCopyTextureInfo *")
                source.buffer, source.layout.offset = buffer._internal, offset + row * pitch
                source.layout.bytesPerRow, source.layout.rowsPerImage = pitch, rows
                target.texture, target.origin.y, target.aspect = texture._internal, row, lib.WGPUTextureAspect_All
                size = ffi.new("WGPUExtent3D *", (columns, rows, 1))
                self.parts.append((source, target, size))
