"""Playback of a trained scene at any time: the interface, and what implements it for a file.

torch is not imported for static scenes and for fields that the device evaluates: that would take longer than the rest.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.motion.fields.config import MIN_SCALE
from lapgs_wgpu.motion.playback.grid_field_playback import GridFieldPlayback
from lapgs_wgpu.motion.scene_file import SceneFile
from lapgs_wgpu.splat.gaussians import Gaussians

Floats = NDArray[np.float32]


class Playback(Protocol):
    """A scene that can be rendered at any time in [0, 1].

    count: number of Gaussians. moves: False for static scenes. metadata: of the checkpoint.
    """

    device: Device
    metadata: dict[str, str]

    @property
    def count(self) -> int: ...
    @property
    def moves(self) -> bool: ...

    def at(self, t: float) -> Gaussians[DeviceArray]:
        """Return the activated Gaussians at a time, on the device. Does not wait for it. Valid until the next call."""

    def snapshot(self, t: float) -> GaussianSnapshot:
        """Return all Gaussians at a time, as 3DGS viewers read them. `Scene4D.save` writes those at time 0."""


def playback_of(file: SceneFile, device: Device) -> Playback:
    """Playback of a file that was read.

    Raises MemoryError if a buffer of all Gaussians exceeds the device's limits. The colors are the largest one: 1.4
    million Gaussians of degree 3 at WebGPU's default limits.
    """
    if file.field_config.kind == "static" or file.field_config.decodes_on_device:
        return DevicePlayback(file, device)
    from lapgs_wgpu.motion.playback.torch_playback import TorchPlayback
    from lapgs_wgpu.motion.scene import scene_of

    return TorchPlayback(scene_of(file, device))


class DevicePlayback:
    """A Playback of static scenes, and of fields that the device evaluates."""

    def __init__(self, file: SceneFile, device: Device) -> None:
        self.device, self.metadata, self._file = device, file.metadata, file
        self.count = len(file.gaussians["means"])
        self.moves = file.field_config.kind != "static"
        activated = activate(file.gaussians, file.sh_degree)
        pool = BufferPool(device)
        arrays = {name: pool.upload(name, activated[name]) for name in ("means", "quats", "scales", "opacities", "sh")}
        self._now = Gaussians(**arrays, antialiased=file.antialiased)
        self._field = GridFieldPlayback(device, file.field_config, file.field, activated) if self.moves else None
        self._time: float | None = None  # of the Gaussians in the buffers, where a field moves them

    def at(self, t: float) -> Gaussians[DeviceArray]:
        t = self._file.timing(t)
        if self._field is not None and self._time != t:
            self._field.move(t, self._now)
            self._time = t
        return self._now

    def static_features(self) -> Floats | None:
        """Return the features (count, F) of a compact scene, which replace the static table; None in static scenes."""
        return self._field.static_features() if self._field else None

    def snapshot(self, t: float) -> GaussianSnapshot:
        means, quats, scales, opacities, colors = read_all(list(self.at(t).arrays().values()))
        logits = self._file.gaussians["opacity_logits"]
        if self._file.field_config.appearance_size == 4:
            logits = opacity_logits(opacities)
        sh = np.concatenate([colors[:, :1], self._file.gaussians["sh_rest"]], axis=1)
        return GaussianSnapshot(means, sh, logits, np.log(scales), quats)


def activate(stored: dict[str, Floats], sh_degree: int) -> dict[str, Floats]:
    """Return the stored arrays, and the activated Gaussians as in `Scene4D.canonical`."""
    quats, used = stored["quats"], (sh_degree + 1) ** 2 - 1
    with np.errstate(over="ignore"):
        scales = np.maximum(np.exp(stored["log_scales"]), np.float32(MIN_SCALE))
    return stored | {
        "quats": quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12),
        "scales": scales,
        "opacities": 0.5 + 0.5 * np.tanh(0.5 * stored["opacity_logits"]),
        "sh": np.concatenate([stored["sh_dc"], stored["sh_rest"][:, :used]], axis=1),
    }


def opacity_logits(opacities: Floats) -> Floats:
    """Return the logits (N,) of opacities (N,), which are clipped to 1e-7 from 0 and 1."""
    inside = np.clip(opacities.astype(np.float64), 1e-7, 1 - 1e-7)
    return np.log(inside / (1 - inside)).astype(np.float32)
