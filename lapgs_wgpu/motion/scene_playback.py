"""Showing a scene that torch evaluates: the fields that the device does not, and a scene that is being trained."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..gpu.buffer import BufferPool
from ..io.ply import StillGaussians
from ..splat.camera import Camera
from ..splat.rasterize import upload_gaussians
from ..splat.rasterizer import GaussianBuffers
from .scene import Scene4D


class ScenePlayback:
    """A Scene4D as it is at each call: parameters, their number and sh_degree may change in between. See Playback."""

    def __init__(self, scene: Scene4D) -> None:
        self.scene = scene
        self.device, self.field_config, self.metadata = scene.device, scene.field_config, scene.metadata
        self.exact = True
        self._pool = BufferPool(scene.device)  # a training draws with its own

    @property
    def count(self) -> int:
        """See Playback."""
        return len(self.scene)

    @property
    def sh_degree(self) -> int:
        """See Playback."""
        return self.scene.sh_degree

    @property
    def moves(self) -> bool:
        """See Playback."""
        return self.scene.field is not None

    def at(self, t: float, seen_by: Camera | None = None) -> GaussianBuffers:
        """See Playback."""
        with torch.no_grad():
            now = self.scene.at(t)
        tensors = [now.means, now.quats, now.scales, now.opacities, now.sh]
        return upload_gaussians(self._pool, tensors, now.sh_degree)

    def means(self, t: float) -> NDArray[np.float32]:
        """See Playback."""
        with torch.no_grad():
            return np.array(self.scene.at(t).means.numpy(force=True))

    def dynamics(self) -> NDArray[np.float32] | None:
        """See Playback."""
        d = self.scene.parameters.get("dynamics")
        return None if d is None else np.array(d.numpy(force=True))

    def still(self, t: float) -> StillGaussians:
        """See Playback."""
        return self.scene.still(t)
