"""Playback of scenes that torch evaluates: other fields, and scenes in training."""

from typing import Any

import torch
from torch import Tensor

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import upload_gaussians


class TorchPlayback:
    """A Playback of a Scene4D in its present state: parameters, their number and sh_degree may change between calls.

    The scene is evaluated only if the time, the degree or a parameter has changed, according to torch's version
    counters. Fused optimizers do not increment them by themselves (train/optimizer).
    """

    def __init__(self, scene: Scene4D) -> None:
        self.scene = scene
        self.device, self.metadata = scene.device, scene.metadata
        self._pool = BufferPool(scene.device)  # a training uses its own
        # A time, degree, and ids and versions of parameters; the parameters, which keep their ids; the Gaussians then.
        self._shown: tuple[tuple[Any, ...], list[Tensor], Gaussians[DeviceArray]] | None = None

    @property
    def count(self) -> int:
        return len(self.scene)

    @property
    def moves(self) -> bool:
        return self.scene.field is not None

    def at(self, t: float) -> Gaussians[DeviceArray]:
        scene = self.scene
        parameters: list[Tensor] = list(scene.parameters.values())
        if scene.field is not None:
            parameters += scene.field.parameters()
        wanted = t, scene.sh_degree, [(id(parameter), parameter._version) for parameter in parameters]
        if self._shown is None or self._shown[0] != wanted:
            self._shown = None  # after a failure the buffers would be inconsistent
            with torch.no_grad():
                self._shown = wanted, parameters, upload_gaussians(self._pool, scene.at(t))
        return self._shown[-1]

    def snapshot(self, t: float) -> GaussianSnapshot:
        return self.scene.snapshot(t)
