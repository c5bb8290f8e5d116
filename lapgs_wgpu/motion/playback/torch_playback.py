"""Playback of scenes that torch evaluates: other fields, and scenes in training."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import Timing
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import upload_gaussians


class _Shown(NamedTuple):
    """The last upload: its time, degree and parameters, each with torch's version counter."""

    gaussians: Gaussians[DeviceArray]
    t: float
    sh_degree: int
    parameters: list[tuple[weakref.ref[Tensor], int]]  # weak references, since a training replaces large tensors

    def is_of(self, scene: Scene4D, t: float) -> bool:
        """Whether an evaluation of the scene would give the same result."""
        parameters = _parameters(scene)
        return (self.t, self.sh_degree, len(self.parameters)) == (t, scene.sh_degree, len(parameters)) and all(
            known() is parameter and version == parameter._version
            for (known, version), parameter in zip(self.parameters, parameters, strict=True)
        )


def _parameters(scene: Scene4D) -> list[Tensor]:
    return [*scene.parameters.values(), *(scene.field.parameters() if scene.field is not None else [])]


class TorchPlayback:
    """A Playback of a Scene4D in its present state: parameters, their number and sh_degree may change between calls.

    The scene is evaluated only if the time, the degree or a parameter has changed, according to torch's version
    counters. Fused optimizers do not increment them by themselves (train/optimizer).
    """

    def __init__(self, scene: Scene4D) -> None:
        self.scene = scene
        self.device, self.field_config, self.metadata = scene.device, scene.field_config, scene.metadata
        self._pool = BufferPool(scene.device)  # a training uses its own
        self._shown: _Shown | None = None

    @property
    def count(self) -> int:
        return len(self.scene)

    @property
    def timing(self) -> Timing:
        return self.scene.timing

    @property
    def sh_degree(self) -> int:
        return self.scene.sh_degree

    @property
    def moves(self) -> bool:
        return self.scene.field is not None

    def at(self, t: float) -> Gaussians[DeviceArray]:
        scene = self.scene
        if self._shown is None or not self._shown.is_of(scene, t):
            self._shown = None  # after a failure the buffers would be inconsistent
            known = [(weakref.ref(parameter), parameter._version) for parameter in _parameters(scene)]
            with torch.no_grad():
                now = scene.at(t)
            self._shown = _Shown(upload_gaussians(self._pool, now), t, scene.sh_degree, known)
        return self._shown.gaussians

    def means(self, t: float) -> NDArray[np.float32]:
        with torch.no_grad():
            return np.array(self.scene.at(t).means.numpy(force=True))

    def dynamics(self) -> NDArray[np.float32] | None:
        d = self.scene.parameters.get("dynamics")
        return None if d is None else np.array(d.numpy(force=True))

    def snapshot(self, t: float) -> GaussianSnapshot:
        return self.scene.snapshot(t)
