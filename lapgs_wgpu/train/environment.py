"""What a run was made with."""

from __future__ import annotations

import platform
from importlib import metadata

import torch

from lapgs_wgpu.gpu.device import Device


def environment(device: Device) -> dict[str, str]:
    """With what a run was made: versions, adapter, driver, torch's threads."""
    packages = ("lapgs-wgpu", "torch", "wgpu", "numpy")
    found = {name.replace("-", "_"): metadata.version(name) for name in packages}
    found |= {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    found |= {"adapter": device.info.name, "backend": device.info.backend, "driver": device.info.driver}
    found["torch_threads"] = str(torch.get_num_threads())
    return found
