"""The 4D scene: canonical Gaussians and the field that moves them; what a checkpoint holds."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import InputError
from ..gpu.device import Device, open_device
from ..io.checkpoint import read_checkpoint, write_checkpoint
from ..io.ply import StillGaussians
from ..splat.camera import Camera
from ..splat.gaussians import Gaussians
from ..splat.rasterize import Rendering, rasterize
from .field import FieldConfig, Grid4DField, make_field
from .hashgrid import HashConfig, make_levels

SH_C0 = 0.28209479177387814
_MIN_SCALE = 1e-7
_MAX_DEGREE = 3
_SHAPES = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "opacity_logits": (),
    "sh_dc": (1, 3),
    "sh_rest": (15, 3),
}


class Scene4D:
    """A moving scene.

    parameters: canonical Gaussians as they are optimised, each an nn.Parameter of float32: means (N, 3) world units,
    log_scales (N, 3), quats (N, 4) wxyz of any length, opacity_logits (N,), sh_dc (N, 1, 3), sh_rest (N, 15, 3).
    field: None where nothing moves. sh_degree: the degree in use, 0 to 3. metadata: what the checkpoint said of itself.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        field_config: FieldConfig,
        device: Device,
        *,
        sh_degree: int = 0,
        seed: int = 0,
    ) -> None:
        self.parameters = {name: nn.Parameter(parameters[name].detach().float().contiguous()) for name in _SHAPES}
        self.field_config = field_config
        self.device = device
        self.sh_degree = sh_degree
        self.field: Grid4DField | None = make_field(field_config, device, seed)
        self.metadata: dict[str, str] = {}

    @staticmethod
    def from_points(
        points: NDArray[np.floating[Any]],
        colors: NDArray[np.floating[Any]],
        scales: NDArray[np.floating[Any]],
        field_config: FieldConfig,
        *,
        opacity: float = 0.1,
        device: Device | None = None,
        seed: int = 0,
    ) -> Scene4D:
        """Round Gaussians at points (N, 3), world units, with colors (N, 3) in [0, 1] and scales (N,)."""
        n = len(points)
        parameters = {
            "means": torch.as_tensor(np.asarray(points, np.float32)),
            "log_scales": torch.as_tensor(np.log(np.asarray(scales, np.float32)))[:, None].repeat(1, 3),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            "opacity_logits": torch.full((n,), float(np.log(opacity / (1 - opacity)))),
            "sh_dc": (torch.as_tensor(np.asarray(colors, np.float32)) - 0.5)[:, None] / SH_C0,
            "sh_rest": torch.zeros(n, 15, 3),
        }
        return Scene4D(parameters, field_config, device or open_device(), seed=seed)

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def _sh(self) -> Tensor:
        used = (self.sh_degree + 1) ** 2 - 1
        return torch.cat([self.parameters["sh_dc"], self.parameters["sh_rest"][:, :used]], dim=1)

    def canonical(self) -> Gaussians:
        """The Gaussians without motion, activated. Differentiable in `parameters`."""
        p = self.parameters
        return Gaussians(
            p["means"],
            nn.functional.normalize(p["quats"], dim=1),
            p["log_scales"].exp().clamp(min=_MIN_SCALE),
            p["opacity_logits"].sigmoid(),
            self._sh(),
        )

    def at(self, t: float) -> Gaussians:
        """The Gaussians at time t in [0, 1], activated. Differentiable in `parameters` and the field's parameters."""
        still = self.canonical()
        if self.field is None or len(self) == 0:
            return still
        move = self.field(self.parameters["means"], t)
        return Gaussians(
            rotate(move.rotation, still.means) + move.translation,
            nn.functional.normalize(still.quats + move.d_quats, dim=1),
            (still.scales + move.d_scales).clamp(min=_MIN_SCALE),
            still.opacities,
            still.sh,
        )

    def render(self, camera: Camera, t: float, background: Tensor | None = None) -> Rendering:
        """The picture of a camera at time t in [0, 1], without gradients. background: (3,), black where None."""
        with torch.no_grad():
            return draw(self.at(t), camera, background, self.device)

    def save(self, path: str | os.PathLike[str], metadata: Mapping[str, str] | None = None) -> None:
        """Write the scene to one file, which 3DGS viewers open as a still at time 0 (docs/format.md). Atomic.

        Raises InputError where the disk or the values do not allow it; an older file then stays as it was.
        """
        with torch.no_grad():
            still = self.at(0.0)
        sh = torch.cat([self.parameters["sh_dc"], self.parameters["sh_rest"]], dim=1)
        arrays = StillGaussians(
            means=still.means.numpy(force=True),
            sh=sh.numpy(force=True),
            opacity_logits=self.parameters["opacity_logits"].numpy(force=True),
            log_scales=still.scales.log().numpy(force=True),
            quats=still.quats.numpy(force=True),
        )
        tensors = {f"gaussians.{name}": value.numpy(force=True) for name, value in self.parameters.items()}
        if self.field is not None:
            tensors |= {f"field.{name}": value.numpy(force=True) for name, value in self.field.state_dict().items()}
        header = {"field": json.dumps(dataclasses.asdict(self.field_config)), "sh_degree": str(self.sh_degree)}
        write_checkpoint(path, arrays, tensors, {**self.metadata, **(metadata or {}), **header})


def draw(
    gaussians: Gaussians, camera: Camera, background: Tensor | None, device: Device, *, depth: bool = True
) -> Rendering:
    """Rasterise activated Gaussians; differentiable. depth: whether to draw it, too."""
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera,
        sh_degree=gaussians.sh_degree,
        background=background,
        depth=depth,
        device=device,
    )


def load(path: str | os.PathLike[str], device: Device | None = None) -> Scene4D:
    """Read a checkpoint, or any 3DGS .ply, which becomes a static scene. Raises InputError."""
    still, tensors, metadata = read_checkpoint(path)
    if not tensors:
        sh = np.zeros((len(still.means), 16, 3), np.float32)
        sh[:, : still.sh.shape[1]] = still.sh
        tensors = {
            "gaussians.means": still.means,
            "gaussians.log_scales": still.log_scales,
            "gaussians.quats": still.quats,
            "gaussians.opacity_logits": still.opacity_logits,
            "gaussians.sh_dc": sh[:, :1],
            "gaussians.sh_rest": sh[:, 1:],
        }
        config, degree = FieldConfig(kind="static"), still.sh_degree
    else:
        config, degree = _read_header(metadata, path)
    count = len(still.means)
    parameters = {}
    for name, shape in _SHAPES.items():
        parameters[name] = _tensor(tensors, f"gaussians.{name}", (count, *shape), path)
    if config.kind != "static":
        _check_tables(config, tensors, path)
    scene = Scene4D(parameters, config, device or open_device(), sh_degree=degree)
    if scene.field is not None:
        state = scene.field.state_dict()
        read = {name: _tensor(tensors, f"field.{name}", tuple(value.shape), path) for name, value in state.items()}
        scene.field.load_state_dict(read)
    scene.metadata = {key: value for key, value in metadata.items() if key not in ("field", "sh_degree")}
    return scene


def _read_header(metadata: Mapping[str, str], path: str | os.PathLike[str]) -> tuple[FieldConfig, int]:
    try:
        values: dict[str, Any] = json.loads(metadata["field"])
        for name in ("static", "temporal"):
            grid: dict[str, Any] = values[name]
            values[name] = HashConfig(grid["levels"], tuple(grid["base"]), tuple(grid["finest"]), grid["table_log2"])
        config, degree = FieldConfig(**values), int(metadata["sh_degree"])
        _check_config(config, degree)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: the checkpoint's description of its field cannot be read ({type(error).__name__}: {error}): "
            "it was damaged, or written by another version of lapgs_wgpu"
        ) from error
    return config, degree


def _check_config(config: FieldConfig, degree: int) -> None:
    """Types and bounds, which keep a damaged or hostile description from asking for what makes no sense."""
    if config.kind not in ("static", "grid4d"):
        raise ValueError(f"unknown field {config.kind!r}")
    if not 0 <= degree <= _MAX_DEGREE:
        raise ValueError(f"sh_degree {degree} is outside 0 to {_MAX_DEGREE}")
    grids = (config.static, config.temporal)
    whole = [config.width, config.depth]
    whole += [n for grid in grids for n in (grid.levels, grid.table_log2, *grid.base, *grid.finest)]
    if not all(type(n) is int for n in whole) or not all(type(n) in (int, float) for n in _reals(config)):
        raise ValueError("a number has the wrong type")
    if not (0 < config.bound < 1e6 and 0 < config.time_scale <= 1 and 1 <= config.width <= 4096):
        raise ValueError("bound, time_scale or width out of range")
    if not 0 <= config.depth <= 16:
        raise ValueError("depth out of range")
    for grid in grids:
        sizes = (*grid.base, *grid.finest)
        if not (1 <= grid.levels <= 64 and 1 <= grid.table_log2 <= 24 and len(sizes) == 6):
            raise ValueError("levels or table_log2 out of range")
        if not all(2 <= size <= 1 << 16 for size in sizes):
            raise ValueError("grid resolution out of range")


def _reals(config: FieldConfig) -> tuple[float, float]:
    return config.bound, config.time_scale


def _check_tables(config: FieldConfig, tensors: Mapping[str, NDArray[Any]], path: str | os.PathLike[str]) -> None:
    """That the tables in the file are of the sizes that the description asks for, before memory is."""
    names = ["static_grid", *(f"temporal_grids.{i}" for i in range(3))]
    for name, grid in zip(names, (config.static, *[config.temporal] * 3), strict=True):
        last = make_levels(grid)[-1]
        _tensor(tensors, f"field.{name}.table", (last.first + last.entries, 2), path)


def _tensor(
    tensors: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...], path: str | os.PathLike[str]
) -> Tensor:
    if name not in tensors:
        raise InputError(f"{path}: the checkpoint has no tensor {name!r}: it was damaged or written by another version")
    array = tensors[name]
    if array.shape != shape:
        raise InputError(f"{path}: tensor {name!r} has shape {array.shape}, but the scene needs {shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{path}: tensor {name!r} holds {int((~np.isfinite(array)).sum())} values that are not finite")
    return torch.from_numpy(np.array(array, np.float32))


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors (N, 3) turned by unit quaternions (N, 4) wxyz."""
    w, axis = q[:, :1], q[:, 1:]
    twice = 2.0 * torch.linalg.cross(axis, v)
    return v + w * twice + torch.linalg.cross(axis, twice)
