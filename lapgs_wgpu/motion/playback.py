"""Scenes ready to be shown."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..gpu.buffer import BufferPool
from ..gpu.device import Device
from ..splat.rasterizer import GaussianBuffers


class Playback(Protocol):
    device: Device
    count: int
    sh_degree: int
    moves: bool
    field_config: Any
    metadata: dict[str, str]

    def at(self, t: float) -> GaussianBuffers: ...
    def means(self, t: float) -> NDArray[np.float32]: ...
    def dynamics(self) -> NDArray[np.float32] | None: ...
    def still(self, t: float) -> Any: ...


class ScenePlayback:
    def __init__(self, scene):
        self.scene = scene
        self.device = scene.device
        self.count = len(scene)
        self.sh_degree = scene.sh_degree
        self.moves = scene.field is not None
        self.field_config = scene.field_config
        self.metadata = scene.metadata
        self._pool = BufferPool(scene.device)

    def at(self, t):
        import torch

        with torch.no_grad():
            g = self.scene.at(t)
        b = {}
        for n in ("means", "quats", "scales", "opacities"):
            a = getattr(g, n).numpy(force=True)
            b[n] = self._pool.get(n, a.nbytes)
            b[n].write(a)
        a = g.sh.numpy(force=True)
        b["colors"] = self._pool.get("colors", a.nbytes)
        b["colors"].write(a)
        return GaussianBuffers(count=self.count, sh_degree=g.sh_degree, sh_stored=a.shape[1], **b)

    def means(self, t):
        import torch

        with torch.no_grad():
            return self.scene.at(t).means.numpy(force=True)

    def dynamics(self):
        d = self.scene.parameters.get("dynamics")
        return None if d is None else d.numpy(force=True)


def open_playback(path, device):
    from .scene import load

    return ScenePlayback(load(path, device))
