"""4D Gaussian splatting on any GPU. The names below are the public interface; each is loaded when it is first used."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lapgs_wgpu.data.load import load_dataset
    from lapgs_wgpu.discovery.discover import start_training
    from lapgs_wgpu.gpu.device import list_devices, open_device
    from lapgs_wgpu.motion.fields.deformation import Deformation
    from lapgs_wgpu.motion.scene import Scene4D, load
    from lapgs_wgpu.splat.camera import Camera
    from lapgs_wgpu.splat.gaussians import Gaussians
    from lapgs_wgpu.splat.rasterization import rasterization
    from lapgs_wgpu.splat.rasterize import Rendering, rasterize
    from lapgs_wgpu.train.densify import Change, DensityState, published_rule
    from lapgs_wgpu.train.parts import Parts, Regularizer, TorchLoss
    from lapgs_wgpu.train.presets import load_config
    from lapgs_wgpu.train.step_result import StepResult
    from lapgs_wgpu.train.trainer import Trainer

# torch's OpenMP threads otherwise spin while they wait, which takes the processor from a software Vulkan driver: a
# training step there is three to ten times slower. It has no effect where torch was imported before.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_NAMES = {
    "data.load": ["load_dataset"],
    "discovery.discover": ["start_training"],
    "gpu.device": ["list_devices", "open_device"],
    "motion.fields.deformation": ["Deformation"],
    "motion.scene": ["Scene4D", "load"],
    "splat.camera": ["Camera"],
    "splat.gaussians": ["Gaussians"],
    "splat.rasterization": ["rasterization"],
    "splat.rasterize": ["Rendering", "rasterize"],
    "train.densify": ["Change", "DensityState", "published_rule"],
    "train.parts": ["Parts", "Regularizer", "TorchLoss"],
    "train.presets": ["load_config"],
    "train.step_result": ["StepResult"],
    "train.trainer": ["Trainer"],
}
__all__ = [
    "Camera", "Change", "Deformation", "DensityState", "Gaussians", "Parts", "Regularizer", "Rendering", "Scene4D",
    "StepResult", "TorchLoss", "Trainer", "list_devices", "load", "load_config", "load_dataset",
    "open_device", "published_rule", "rasterization", "rasterize", "start_training",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.metadata.version("lapgs-wgpu")
    for home, names in _NAMES.items():
        if name in names:
            return getattr(importlib.import_module(f".{home}", __name__), name)
    raise AttributeError(f"module 'lapgs_wgpu' has no attribute {name!r}")
