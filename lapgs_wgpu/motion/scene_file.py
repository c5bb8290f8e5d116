"""Read and validate the scene in a file as arrays, without torch, for Scene4D and for playback."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.checkpoint import read_checkpoint
from lapgs_wgpu.io.dataclass_table import build_dataclass, checked
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.io.lapgs_file import lapgs_bytes, pack_lapgs, unpack_lapgs
from lapgs_wgpu.io.safe_json_toml import PathLike, parse_json
from lapgs_wgpu.io.safetensors_file import Tensors
from lapgs_wgpu.motion.compact_scene import compress, expand, tensor_of
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.timing import EVEN, Timing, timing_of_text

_SHAPES = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh_dc": (1, 3), "sh_rest": (15, 3)}


@dataclass(frozen=True, eq=False)
class SceneFile:
    """The content of a file, float32.

    gaussians: canonical ones by name, (N, ...) with rows as in `row_shapes`; in a compact scene that moves, with
    static_features (N, F) in place of the field's static table. field: the field's parameters by name, in the shapes of
    `parameter_shapes`. metadata: further texts. antialiased: how the Gaussians are drawn, see Gaussians. timing: of the
    capture.
    """

    path: PathLike
    field_config: FieldConfig
    sh_degree: int
    gaussians: dict[str, NDArray[np.float32]]
    field: dict[str, NDArray[np.float32]]
    metadata: dict[str, str]
    antialiased: bool | float = False
    timing: Timing = EVEN


def read_scene(path: PathLike) -> SceneFile:
    """Read a checkpoint, a compact scene, or any 3DGS .ply file as a static scene. Raises InputError."""
    if (data := lapgs_bytes(path)) is not None:
        return read_compact(data, path)
    still, tensors, metadata = read_checkpoint(path)
    if not tensors:
        sh = np.zeros((len(still.means), 16, 3), np.float32)
        sh[:, : still.sh.shape[1]] = still.sh
        stored = vars(still) | {"sh_dc": sh[:, :1], "sh_rest": sh[:, 1:]}
        tensors = {f"gaussians.{name}": stored[name] for name in _SHAPES}
        metadata |= {"field": '{"kind": "static"}', "sh_degree": str(still.sh_degree)}
    header = _read_header(metadata, path)
    config, count = header["field_config"], len(still.means)
    rows = {name: (count, *shape) for name, shape in row_shapes(config).items()}
    # Before a module is created: a damaged description may ask for more memory than there is.
    shapes = parameter_shapes(config)
    if config.kind == "own":  # its module, which checks them, comes from elsewhere
        shapes = {name[6:]: array.shape for name, array in tensors.items() if name.startswith("field.")}
    gaussians = {name: _float32(tensors, f"gaussians.{name}", shape, path) for name, shape in rows.items()}
    field = {name: _float32(tensors, f"field.{name}", shape, path) for name, shape in shapes.items()}
    return SceneFile(path, gaussians=gaussians, field=field, **header)


def read_compact(data: bytes, path: PathLike) -> SceneFile:
    """As `read_scene`, of the bytes of a compact scene. path: where they are from."""
    tensors, metadata = unpack_lapgs(data, str(path))
    header = _read_header(metadata, path)
    gaussians, field = expand(tensors, header["field_config"], header["sh_degree"], str(path))
    return SceneFile(path, gaussians=gaussians, field=field, **header)


def compact_bytes(file: SceneFile, static_features: NDArray[np.float32] | None, *, finer: float = 1.0) -> bytes:
    """Return the bytes of a compact scene (docs/format.md). Raises InputError where only torch evaluates the field.

    static_features: (N, F) of the Gaussians of a checkpoint that moves, else None. finer: see `compress`.
    """
    config = file.field_config
    if config.kind != "static" and not config.decodes_on_device:
        raise InputError(
            f"{file.path}: only torch evaluates its field ({config.kind}, {config.depth} hidden layers, "
            f"motion {config.motion}), which no compact scene holds; --export FOLDER --frames N writes stills"
        )
    gaussians = file.gaussians | ({} if static_features is None else {"static_features": static_features})
    header = scene_header(config, file.sh_degree, file.antialiased, file.timing)
    look = InitialView.from_json(file.metadata.get("view", ""))
    try:
        tensors = compress(gaussians, file.field, config, file.sh_degree, look, finer)
        return pack_lapgs(tensors, file.metadata | header)
    except InputError as error:
        raise InputError(f"{file.path}: no compact scene can be made of it, because {error}") from error


def scene_header(config: FieldConfig, sh_degree: int, antialiased: bool | float, timing: Timing) -> dict[str, str]:
    """Return the texts that a file needs beside its arrays, by name."""
    header = {"field": json.dumps(dataclasses.asdict(config)), "sh_degree": str(sh_degree)}
    if antialiased:
        header["antialiased"] = json.dumps(antialiased)
    if timing is not EVEN:
        header["timing"] = timing.to_text()
    return header


def row_shapes(config: FieldConfig) -> dict[str, tuple[int, ...]]:
    """Return the parameters of each Gaussian with this field: name -> shape of a row."""
    size = config.dynamics_size
    return _SHAPES | ({"dynamics": (size,)} if size else {})


def _read_header(metadata: Mapping[str, str], path: PathLike) -> dict[str, Any]:
    """Return the attributes of a SceneFile that its texts hold, and the others of these."""
    others = dict(metadata)
    try:
        config = build_dataclass(FieldConfig, parse_json(others.pop("field"), "its text"), "field")
        degree = int(others.pop("sh_degree"))
        if not 0 <= degree <= 3:
            raise ValueError(f"sh_degree {degree} is outside 0 to 3")
        antialiased = checked(bool | float, others.pop("antialiased", "false"), "antialiased")  # older files lack it
        timing = timing_of_text(others.pop("timing")) if "timing" in others else EVEN
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"[:200]
        raise InputError(
            f"{path}: the checkpoint's description of its field cannot be read ({reason}): "
            "it was damaged, or written by another version of lapgs_wgpu"
        ) from error
    described = {"field_config": config, "sh_degree": degree, "antialiased": antialiased, "timing": timing}
    return described | {"metadata": others}


def _float32(tensors: Tensors, name: str, shape: tuple[int, ...], path: PathLike) -> NDArray[np.float32]:
    array = tensor_of(tensors, name, shape, str(path))
    values = array.astype(np.float32, copy=False)
    if values is not array and not np.isfinite(values).all():  # all values are finite before the conversion
        raise InputError(f"{path}: tensor {name!r} holds values beyond float32: it was written by another program")
    return values
