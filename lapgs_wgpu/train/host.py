"""The host of a training: threads of torch in a step, memory of the C library, and with what a run was made."""

import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata

import torch

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
SMALL_WIDTH = 64  # of a decoder whose operators are too short to share


def step_threads(field: FieldConfig, device: Device) -> int | None:
    """The number of threads; None for torch's own, which the environment variable OMP_NUM_THREADS sets.

    On a CPU device a step alternates between torch and the driver, and a thread of torch that waits for its next
    operator keeps the driver's from a core. The decoder of a GridField has threads of its own; another that is small
    gains less by a second thread of torch than the driver loses (docs/notes/speed.md).
    """
    own = field.kind in ("grid4d", "laplacian") and not field.depth
    single = own or field.kind == "static" or field.width <= SMALL_WIDTH
    return 1 if device.is_cpu and single and "OMP_NUM_THREADS" not in os.environ else None


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Let torch use so many threads in the `with` block; None: no change."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def keep_freed_memory() -> None:
    """Let glibc keep the blocks of up to 32 MB that are freed, for the whole process.

    By default it gives each back to the system at once. A step asks for the same ones again, and the system then clears
    every page anew, which took most of the time of torch's part on a CPU. Larger ones, of which a step has few, still
    go back: kept, they would leave holes that nothing fits into. Other C libraries are left alone.
    """
    if library := _glibc():
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 25)  # the largest that it takes
        library.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def return_freed_memory() -> None:
    """Give the system back what `keep_freed_memory` kept: what follows asks for blocks of other sizes."""
    if library := _glibc():
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    return ctypes.CDLL(None) if sys.platform == "linux" and platform.libc_ver()[0] == "glibc" else None


def environment(device: Device) -> dict[str, str]:
    """With what a run was made: versions, adapter, driver, torch's threads."""
    packages = ("lapgs-wgpu", "torch", "wgpu", "numpy")
    found = {name.replace("-", "_"): metadata.version(name) for name in packages}
    found |= {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    found |= {"adapter": device.info.name, "backend": device.info.backend, "driver": device.info.driver}
    found["torch_threads"] = str(torch.get_num_threads())
    return found
