"""What a run was made with, and the memory that its process takes."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import torch

from lapgs_wgpu.gpu.device import Device


def resident_bytes() -> int | None:
    """Memory of this process at present; where the system does not tell, the most so far; None where it tells
    neither."""
    with suppress(OSError, ValueError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    with suppress(ImportError):
        import resource

        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else 1024 * most
    return None


def environment(device: Device) -> dict[str, str]:
    """With what a run was made: versions, adapter, driver, torch's threads, the git revision of a checkout."""
    packages = ("lapgs-wgpu", "torch", "wgpu", "numpy")
    found = {name.replace("-", "_"): metadata.version(name) for name in packages}
    found |= {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    found |= {"adapter": device.info.name, "backend": device.info.backend, "driver": device.info.driver}
    found["torch_threads"] = str(torch.get_num_threads())
    checkout = Path(__file__).parents[2]
    if (checkout / ".git").exists():
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
            found["revision"] = done.stdout.strip()
        except (OSError, subprocess.SubprocessError):
            pass  # no git here, or not ours to read: the versions must do
    return found
