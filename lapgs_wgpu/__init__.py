"""4D Gaussian splatting on any GPU. The names below are the public interface; each is loaded when it is first used."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .gpu.device import list_devices, open_device
    from .motion.scene import Scene4D, load
    from .splat.camera import Camera
    from .splat.gaussians import Gaussians
    from .splat.rasterize import Rendering, rasterize

# torch's OpenMP threads otherwise spin while they wait, which takes the processor from a software Vulkan driver: a
# training step there is three to ten times slower. It has no effect where torch was imported before.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_HOMES = {
    "rasterize": "splat.rasterize",
    "Rendering": "splat.rasterize",
    "Camera": "splat.camera",
    "Gaussians": "splat.gaussians",
    "Scene4D": "motion.scene",
    "load": "motion.scene",
    "list_devices": "gpu.device",
    "open_device": "gpu.device",
}
__all__ = ["Camera", "Gaussians", "Rendering", "Scene4D", "list_devices", "load", "open_device", "rasterize"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'lapgs_wgpu' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
