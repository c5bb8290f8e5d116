"""Blocks of memory that are freed and asked for again are not cleared by the system each time, and given back in the
end."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import torch
from lapgs_wgpu.train.malloc import keep_freed_memory

if sys.argv[1] == "keep":
    keep_freed_memory()
torch.set_num_threads(1)
for i in range(20):
    if i == 15:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [torch.full((5_000_000,), 1.0) for _ in range(5)]
    del blocks
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


RETURNED = """
import torch
from lapgs_wgpu.train.malloc import keep_freed_memory, return_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

keep_freed_memory()
blocks = [torch.full((5_000_000,), 1.0) for _ in range(10)]
last = torch.ones(1000)  # behind them, so that the heap does not end with what is freed
del blocks
before = resident()
return_freed_memory()
print(before - resident())
"""


def page_faults(how: str) -> int:
    """Of a process that fills five blocks of 20 MB five times, after it has done so before."""
    command = [sys.executable, "-c", SCRIPT, how]
    # As glibc starts. Later it raises both on its own, and gives back or not as the heap happens to end.
    start = os.environ | {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072"}
    return int(subprocess.run(command, check=True, capture_output=True, text=True, timeout=120, env=start).stdout)


@pytest.mark.nightly
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_freed_memory_is_used_again() -> None:
    assert page_faults("keep") < 100
    assert page_faults("default") > 5 * 100  # else there would be nothing to gain


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_freed_memory_is_given_back() -> None:
    command = [sys.executable, "-c", RETURNED]
    freed = int(subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout)
    assert freed > 150e6  # of 200 MB
