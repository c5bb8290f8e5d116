"""Playback of a trained scene at any time: the interface, and what implements it for a file.

torch is not imported for static scenes and for fields that the device evaluates: that would take longer than the rest.
"""

import math
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.motion.fields.config import GEOMETRY, MIN_SCALE, static_grid, temporal_grids
from lapgs_wgpu.motion.passes.hash_encoder_passes import HashEncoderPasses, PointSet
from lapgs_wgpu.motion.scene_file import SceneFile
from lapgs_wgpu.splat.gaussians import Gaussians

Floats = NDArray[np.float32]

_LANES = 64  # deform.wgsl
_CANONICAL = 16  # deform.wgsl: floats of a Gaussian before its still features
_BLOCK_BYTES = 128 << 20  # of the features that a dispatch reads: WebGPU's default limit of a binding
# Where deform.wgsl has the outputs of the heads among its floats: turn, shift, quaternion, scale; color, opacity.
_PLACES = np.array([*range(4), 8, 9, 10, *range(4, 8), 12, 13, 14, 16, 17, 18, 11])


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
    if file.field_config.kind == "static":
        return DevicePlayback(file, device)
    if file.field_config.decodes_on_device:
        return GridFieldPlayback(file, device)
    from lapgs_wgpu.motion.playback.torch_playback import TorchPlayback
    from lapgs_wgpu.motion.scene import scene_of

    return TorchPlayback(scene_of(file, device))


class DevicePlayback:
    """A Playback of static scenes. activated: what `activate` returns of the file, where somebody has it."""

    moves = False

    def __init__(self, file: SceneFile, device: Device, activated: dict[str, Floats] | None = None) -> None:
        self.device, self.metadata, self._file = device, file.metadata, file
        self._config, self._pool = file.field_config, BufferPool(device)
        self.count = len(file.gaussians["means"])
        activated = activated or activate(file.gaussians, file.sh_degree)
        names = ("means", "quats", "scales", "opacities", "sh")
        arrays = {name: self._pool.upload(name, activated[name]) for name in names}
        self._now = Gaussians(**arrays, antialiased=file.antialiased)

    def at(self, t: float) -> Gaussians[DeviceArray]:
        return self._now

    def static_features(self) -> Floats | None:
        """Return the features (count, F) of a compact scene, which replace the static table; None in static scenes."""
        return None

    def snapshot(self, t: float) -> GaussianSnapshot:
        means, quats, scales, opacities, colors = read_all(list(self.at(t).arrays().values()))
        logits = self._file.gaussians["opacity_logits"]
        if self._config.appearance_size == 4:
            logits = opacity_logits(opacities)
        sh = np.concatenate([colors[:, :1], self._file.gaussians["sh_rest"]], axis=1)
        return GaussianSnapshot(means, sh, logits, np.log(scales), quats)


class GridFieldPlayback(DevicePlayback):
    """A Playback of fields that `decodes_on_device`.

    What does not depend on the time is computed once. A time then costs the temporal encoding and one pass, `deform`.
    Gaussians with static_features (N, F) need no static table.
    """

    moves = True

    def __init__(self, file: SceneFile, device: Device) -> None:
        gaussians = activate(file.gaussians, file.sh_degree)
        super().__init__(file, device, gaussians)
        config, self._parameters = self._config, file.field
        self._time: float | None = None  # of the Gaussians in the buffers
        self._defines = {"POINTS": 4, "QUADS": 2} if device.is_cpu else {"POINTS": 2, "QUADS": 1}
        self._defines["HEADS"] = 5 if config.appearance_size else 4
        self._motion_heads = 4 if config.kind == "laplacian" else 0
        self._channels = 4 * self._defines["QUADS"]  # a round
        self._rounds = -(-config.width // self._channels)
        grids, self._static = temporal_grids(config), static_grid(config).features
        column = config.dynamics_size + config.dynamics_size % 2  # of temporal features, which come in pairs
        # Lengths of the rows that the pass reads, in quads of four floats.
        self._still_quads = -(-self._static // 4)
        self._moving_quads = -(-(column + sum(grid.features for grid in grids)) // 4)
        row = max(_CANONICAL + 4 * self._still_quads, 4 * self._moving_quads)
        size = _BLOCK_BYTES // (4 * row) // _LANES * _LANES
        # By their first Gaussian: the inputs of each dispatch.
        self._blocks = {first: self._block(gaussians, first, size) for first in range(0, self.count, size)}
        self._temporal = HashEncoderPasses(device, grids, config.bound, row=4 * self._moving_quads, column=column)
        names = [f"temporal_grids.{i}.table" for i in range(len(grids))]
        self._tables = [self._pool.upload(name, self._parameters[name]) for name in names]
        if "static_features" not in gaussians:
            row = _CANONICAL + 4 * self._still_quads
            encoder = HashEncoderPasses(device, [static_grid(config)], config.bound, row=row, column=_CANONICAL)
            # Not in the pool, since it is needed once.
            table = DeviceArray.upload(device, "static table", self._parameters["static_grid.table"])
            with Commands(device) as commands:
                for first, block in self._blocks.items():
                    points = PointSet(first, block["points"], block["points"].shape[0], float)
                    encoder.encode(commands, points, [table], block["still"])
        heads = self._heads(0.0)
        self._stream_at = len(heads)
        self._weights = self._pool.upload("weights", np.concatenate([heads, self._stream()]))

    def at(self, t: float) -> Gaussians[DeviceArray]:
        t = self._file.timing(t)
        if self._time != t:
            self._move(t)
            self._time = t
        return self._now

    def static_features(self) -> Floats:
        columns = slice(_CANONICAL, _CANONICAL + self._static)
        return np.concatenate([block["still"].read()[:, columns] for block in self._blocks.values()])

    def _block(self, gaussians: dict[str, Floats], first: int, size: int) -> dict[str, DeviceArray]:
        """Upload what a dispatch of at most `size` Gaussians reads: points (count, 4), still (count, 16 + still
        features), and moving (count, dynamics and temporal features)."""
        g = {name: array[first : first + size] for name, array in gaussians.items()}
        count = len(g["means"])
        points = np.zeros((count, 4), np.float32)
        points[:, :3] = g["means"]
        still = np.zeros((count, _CANONICAL + 4 * self._still_quads), np.float32)
        still[:, :3], still[:, 3], still[:, 4:8] = g["means"], g["opacity_logits"], g["quats"]
        still[:, 8:11], still[:, 12:15] = g["scales"], g["sh"][:, 0]
        still[:, 11] = self._config.negative_scales == "mirror"
        if "static_features" in g:
            still[:, _CANONICAL : _CANONICAL + self._static] = g["static_features"]
        moving = np.zeros((count, max(4, 4 * self._moving_quads)), np.float32)
        if self._config.dynamics_size:
            moving[:, : self._config.dynamics_size] = g["dynamics"]
        named = {"points": points, "still": still, "moving": moving}
        return {name: self._pool.upload(f"{name} from {first}", array) for name, array in named.items()}

    def _columns(self, weight: Floats, quads: int) -> Floats:
        """Rearrange a weight (width, inputs): (rounds, input quads, output quads of a round, 4 inputs, 4 outputs)."""
        padded = np.zeros((self._rounds * self._channels, 4 * quads), np.float32)
        padded[: weight.shape[0], : weight.shape[1]] = weight
        return padded.reshape(self._rounds, self._channels // 4, 4, quads, 4).transpose(0, 3, 1, 4, 2)

    def _stream(self) -> Floats:
        """Return the vectors (V, 4) of biases and layers of the decoder, in the order in which the pass reads them."""
        p, dynamics, rounds = self._parameters, self._config.dynamics_size, self._rounds
        p = p | {name: np.float32(0.5) * p[name] for name in ("spatial.weight", "spatial.bias")}  # see common/gate.wgsl
        moving = p["temporal.weight"][:, : None if self._tables else dynamics]  # a layer without inputs has one column
        if dynamics % 2:
            moving = np.insert(moving, dynamics, 0, axis=1)
        still, biases = ["spatial"], ["spatial", "temporal"]
        if self._config.kind == "laplacian":
            still, biases = [*still, "motion.first"], [*biases, "motion.first"]
        starts = np.concatenate([self._columns(p[f"{name}.bias"][:, None], 1)[:, 0, :, :1] for name in biases], axis=2)
        layers = [self._columns(p[f"{name}.weight"], self._still_quads) for name in still]
        parts = [starts, np.stack(layers, axis=4), self._columns(moving, self._moving_quads)]
        return np.concatenate([part.reshape(rounds, -1, 4) for part in parts], axis=1).reshape(-1, 4)

    def _heads(self, t: float) -> Floats:
        """Return the vectors (V, 4) of the heads: biases, and weights by channel; the Laplacian motion is folded in."""
        p, width, heads = self._parameters, self._config.width, self._defines["HEADS"]
        names = ["heads", "appearance"] if self._config.appearance_size else ["heads"]
        factors = np.array(self._config.head_factors, np.float32)
        weight = np.concatenate([p[f"{name}.weight"] for name in names]) * factors[:, None]
        bias = np.concatenate([p[f"{name}.bias"] for name in names]) * factors
        places, moved = _PLACES[: len(factors)], sum(GEOMETRY)
        start = np.zeros(4 * heads, np.float32)
        columns = np.zeros((self._rounds * self._channels, 4 * (heads + self._motion_heads)), np.float32)
        columns[:width, places] = weight.T
        if self._motion_heads:  # as in GridField, only the geometry heads read A_L
            phase = 2 * math.pi * t * p["motion.frequencies"].astype(np.float64)
            series = np.cos(phase) @ p["motion.alpha"] + np.sin(phase) @ p["motion.beta"]
            second = weight[:moved] @ (series[:, None] * p["motion.second.weight"])
            columns[:width, 4 * heads + places[:moved]] = second.T
            bias[:moved] += weight[:moved] @ (series * p["motion.second.bias"])
        start[places] = bias
        return np.concatenate([start, columns.reshape(-1)]).reshape(-1, 4)

    def _move(self, t: float) -> None:
        """Submit the passes that write the Gaussians at a time in [0, 1]; of the colors only the constant part, if the
        field changes colors."""
        color = self._config.appearance_size > 0
        kernel = Kernel.get(self.device, "deform", MOTION=self._motion_heads > 0, COLOR=color, **self._defines)
        heads = self._heads(t)
        self._weights.rows(0, len(heads)).write(heads)
        sizes = {"rounds": self._rounds, "still_quads": self._still_quads, "moving_quads": self._moving_quads}
        sizes |= {"stream": self._stream_at, "sh_stored": self._now.sh.shape[1]}
        with Commands(self.device) as commands:
            for first, block in self._blocks.items():
                count = block["points"].shape[0]
                points = PointSet(first, block["points"], count, partial(self._config.grid_time, t))
                self._temporal.encode(commands, points, self._tables, block["moving"])
                arrays = block | {name: array.rows(first, count) for name, array in self._now.arrays().items()}
                deform = self._pool.constant(kernel.uniform("Deform", gaussians=count, **sizes))
                arrays |= {"colors": arrays["sh"], "weights": self._weights, "deform": deform}
                commands.run(kernel, -(-count // (_LANES * self._defines["POINTS"])), arrays)
                commands.flush()  # all blocks together may take longer than a watchdog allows


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
