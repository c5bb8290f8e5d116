"""Read and validate the scene in a file as arrays, without torch, for Scene4D and for playback."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io.checkpoint import read_checkpoint
from ..io.dataclass_table import build_dataclass
from ..io.safe_json_toml import parse_json
from .fields.config import FieldConfig
from .fields.parameter_shapes import parameter_shapes

_MAX_DEGREE = 3
_SHAPES = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "opacity_logits": (),
    "sh_dc": (1, 3),
    "sh_rest": (15, 3),
}


@dataclass(frozen=True, eq=False)
class SceneFile:
    """The content of a file, float32.

    gaussians: canonical ones by name, (N, ...) with rows as in `row_shapes`. field: the field's parameters by name, in
    the shapes of `parameter_shapes`. metadata: further texts.
    """

    path: str | os.PathLike[str]
    field_config: FieldConfig
    sh_degree: int
    gaussians: dict[str, NDArray[np.float32]]
    field: dict[str, NDArray[np.float32]]
    metadata: dict[str, str]


def read_scene(path: str | os.PathLike[str]) -> SceneFile:
    """Read a checkpoint, or any 3DGS .ply file as a static scene. Raises InputError."""
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
    gaussians = {
        name: _tensor(tensors, f"gaussians.{name}", (count, *shape), path) for name, shape in row_shapes(config).items()
    }
    texts = {key: value for key, value in metadata.items() if key not in ("field", "sh_degree")}
    # Before a module is created: a damaged description may ask for more memory than there is.
    field = {name: _tensor(tensors, f"field.{name}", shape, path) for name, shape in parameter_shapes(config).items()}
    return SceneFile(path, config, degree, gaussians, field, texts)


def row_shapes(config: FieldConfig) -> dict[str, tuple[int, ...]]:
    """Parameters of each Gaussian with this field: name -> shape of a row."""
    size = config.dynamics_size
    return _SHAPES | ({"dynamics": (size,)} if size else {})


def _read_header(metadata: Mapping[str, str], path: str | os.PathLike[str]) -> tuple[FieldConfig, int]:
    try:
        config = build_dataclass(FieldConfig, parse_json(metadata["field"], "its text"), "field")
        degree = int(metadata["sh_degree"])
        if not 0 <= degree <= _MAX_DEGREE:
            raise ValueError(f"sh_degree {degree} is outside 0 to {_MAX_DEGREE}")
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"[:200]
        raise InputError(
            f"{path}: the checkpoint's description of its field cannot be read ({reason}): "
            "it was damaged, or written by another version of lapgs_wgpu"
        ) from error
    return config, degree


def _tensor(
    tensors: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...], path: str | os.PathLike[str]
) -> NDArray[np.float32]:
    if name not in tensors:
        raise InputError(f"{path}: the checkpoint has no tensor {name!r}: it was damaged or written by another version")
    array = tensors[name]
    if array.shape != shape:
        raise InputError(f"{path}: tensor {name!r} has shape {array.shape}, but the scene needs {shape}")
    values = array.astype(np.float32, copy=False)
    if values is not array and not np.isfinite(values).all():  # all values are finite before the conversion
        raise InputError(f"{path}: tensor {name!r} holds values beyond float32: it was written by another program")
    return values
