"""How the C library hands out memory while a training runs."""

from __future__ import annotations

import ctypes
import platform
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
_LARGEST = 2**31 - 1
_LARGEST_THRESHOLD = 1 << 25  # that glibc takes


def keep_freed_memory() -> None:
    """Let glibc keep the blocks of up to 32 MB that are freed, for the whole process.

    By default it gives each back to the system at once. A step asks for the same ones again, and the system then clears
    every page anew, which took most of the time of torch's part on a CPU. Larger ones, of which a step has few, still
    go back: kept, they would leave holes that nothing fits into. Other C libraries are left alone.
    """
    if _is_glibc():
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, _LARGEST_THRESHOLD)
        library.mallopt(_M_TRIM_THRESHOLD, _LARGEST)


def return_freed_memory() -> None:
    """Give the system back what `keep_freed_memory` kept: what follows asks for blocks of other sizes."""
    if _is_glibc():
        ctypes.CDLL(None).malloc_trim(0)


def _is_glibc() -> bool:
    return sys.platform == "linux" and platform.libc_ver()[0] == "glibc"
