"""Errors of the native library: what it reports of a call, a device whose memory is exhausted, and a lost one.

wgpu-py (0.32) raises both exhausted memory and a lost device at the call: the first as a validation error, the second
as one or, when mapping a buffer, as an AttributeError. A submission that the library refuses ends the process instead.
Hence commands are finished right before their submission, where a lost device raises an error in time, and sizes are
checked before buffers are created.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import wgpu
from wgpu.backends.wgpu_native._api import error_handler
from wgpu.backends.wgpu_native._helpers import ERROR_TYPES

from lapgs_wgpu.errors import DeviceError, DeviceLostError, DeviceMemoryError
from lapgs_wgpu.gpu.device import Device


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


@contextmanager
def translated_errors(device: Device, what: str, nbytes: int = 0) -> Iterator[None]:
    """Turn exhausted memory and a lost device into a DeviceError; other errors pass unchanged.

    what: purpose of the memory. nbytes: its size, 0 if unknown.
    """
    try:
        yield
    except DeviceError:
        raise
    except (wgpu.GPUError, RuntimeError, AttributeError) as error:
        if isinstance(error, wgpu.GPUOutOfMemoryError) or "Not enough memory left" in str(error):
            size = f" of {nbytes / 1e6:.0f} MB" if nbytes else ""
            raise DeviceMemoryError(
                f"{device.info.name} has no memory left for {what}{size}, fewer Gaussians or smaller pictures need less"
            ) from error
        check_not_lost(device)
        raise


def check_not_lost(device: Device) -> None:
    """Raise DeviceLostError if the device is lost."""
    try:
        device.wgpu_device.create_buffer(size=16, usage=wgpu.BufferUsage.COPY_DST)
    except wgpu.GPUError as error:
        if "device is lost" in str(error):
            reason = "because its driver gave up or it was removed"
            raise DeviceLostError(f"{device.info.name} was lost, {reason}") from error
