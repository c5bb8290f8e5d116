"""Playback of scenes whose field only torch evaluates."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import upload_gaussians


class TorchPlayback:
    """A Playback of a Scene4D that does not change. It is evaluated only if the time has changed."""

    def __init__(self, scene: Scene4D) -> None:
        self.scene = scene
        self.device, self.field_config, self.metadata = scene.device, scene.field_config, scene.metadata
        self.count, self.sh_degree, self.timing = len(scene), scene.sh_degree, scene.timing
        self.moves = scene.field is not None
        self._pool = BufferPool(scene.device)
        self._shown: tuple[float, Gaussians[DeviceArray]] | None = None  # of which time, and what

    def at(self, t: float) -> Gaussians[DeviceArray]:
        if self._shown is None or self._shown[0] != t:
            self._shown = None  # after a failure the buffers would be inconsistent
            with torch.no_grad():
                now = self.scene.at(t)
            self._shown = t, upload_gaussians(self._pool, now)
        return self._shown[1]

    def means(self, t: float) -> NDArray[np.float32]:
        with torch.no_grad():
            return np.array(self.scene.at(t).means.numpy(force=True))

    def snapshot(self, t: float) -> GaussianSnapshot:
        return self.scene.snapshot(t)
