"""A scene for playback alone, a tenth of its checkpoint: quantized, and without what playback does not read.

The static hash grid is read only at the canonical means, so each Gaussian carries its features instead of the table.
docs/format.md has the tensors; the web page (viewer/web) reads the same file.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.io.safetensors_file import Array, Tensors
from lapgs_wgpu.motion.fields.config import MIN_SCALE, FieldConfig, static_grid, temporal_grids
from lapgs_wgpu.motion.fields.parameter_shapes import Shapes, parameter_shapes
from lapgs_wgpu.motion.quantize import Quantized, dequantize, quantize
from lapgs_wgpu.splat.constants import CONSTANTS

Floats = NDArray[np.float32]
Arrays = dict[str, Floats]

_TABLE_BITS = 8
_EXACT = "motion.frequencies"  # a phase is up to 2 pi times this: 16 bits would move the end of the clip
_MOST_LOGIT = 16.0  # beyond it an opacity is 0 or 1 to seven digits
# Largest errors of a value by what they change in a picture.
_SHIFT = 0.03  # of a mean, standard deviations of the Gaussian
_SHIFT_PIXELS = 0.1  # of a mean
_TURN = 0.2  # of where a turned Gaussian's longest axis ends, of its shortest one; or four pixels
_WIDENING = 0.06  # of a variance, with the one of a pixel that drawing adds
_OPACITY = 0.012  # of an opacity above _FAINT; below it of opacity / _FAINT
_FAINT = 0.1
_COLOR = 0.008  # of a color, where 1 is white; of colors above that a share
_HARMONIC = 0.04  # of a higher harmonic's coefficient
_PIXELS = 1000  # of the picture's height in which a pixel is meant
_NEAREST = 0.25  # of the initial distance: what a viewer comes near to


def _row_formats(config: FieldConfig, sh_degree: int) -> dict[str, tuple[int, int, bool]]:
    """Return by name of what a scene holds of each Gaussian the number of values, the bits of each, and whether zero is
    exact. docs/results.md has what fewer bits cost."""
    formats = {
        "means": (3, 16, False),
        "log_scales": (3, 8, False),
        "quats": (4, 8, True),
        "opacity_logits": (1, 8, False),
        "sh_dc": (3, 8, False),
        "sh_rest": (3 * ((sh_degree + 1) ** 2 - 1), 5, True),
        "dynamics": (config.dynamics_size, 6, True),
        "static_features": (static_grid(config).features if config.kind != "static" else 0, 6, True),
    }
    return {name: row for name, row in formats.items() if row[0]}


def _field_shapes(config: FieldConfig) -> Shapes:
    return {name: shape for name, shape in parameter_shapes(config).items() if name != "static_grid.table"}


def compress(
    gaussians: Mapping[str, Floats],
    field: Mapping[str, Floats],
    config: FieldConfig,
    sh_degree: int,
    look: InitialView | None,
    finer: float,
) -> dict[str, Array]:
    """Return the tensors of a compact scene, without Gaussians that are too faint to be drawn at any time.

    gaussians: as SceneFile has them, and "static_features" (N, F) where the scene moves. field: as SceneFile has it.
    look: from where and how near it is seen; None: so near that only the Gaussians' own sizes count.
    finer: factor of the largest errors that are allowed.
    """
    formats = _row_formats(config, sh_degree)
    held = held_rows(gaussians["opacity_logits"], config)
    stored = {name: gaussians[name][held].reshape(len(held), -1)[:, :size] for name, (size, _, _) in formats.items()}
    stored["log_scales"] = np.maximum(stored["log_scales"], np.float32(math.log(MIN_SCALE)))
    stored["quats"] = stored["quats"] / np.maximum(np.linalg.norm(stored["quats"], axis=1, keepdims=True), 1e-12)
    stored["opacity_logits"] = stored["opacity_logits"].clip(-_MOST_LOGIT, _MOST_LOGIT)
    tensors: dict[str, Array] = {}

    def add(
        name: str, values: Floats, bits: int, centered: bool, most: NDArray[np.floating] | None, starts: Sequence[int]
    ) -> None:
        if most is None:  # of features: half a step of their range, as only the field knows more
            largest = np.maximum.reduceat(np.abs(values), starts)
            most = np.repeat(largest / ((1 << bits) - 2) * 1.01, np.diff([*starts, len(values)]), axis=0)
        whole, ranges, outliers, exact = quantize(values, bits, finer * most, centered=centered, starts=starts)
        tensors.update({name: whole, f"{name}.range": ranges})
        if len(outliers):
            tensors.update({f"{name}.outliers": outliers, f"{name}.exact": exact})

    allowed = _allowed_errors(stored, config.appearance_size == 4, look)
    for name, (_, bits, centered) in formats.items():
        add(f"gaussians.{name}", stored[name], bits, centered, allowed.get(name), [0])
    for name in _field_shapes(config):
        values = field[name]
        if name.endswith(".table"):
            add(f"field.{name}", values, _TABLE_BITS, True, None, _table_starts(config))
        else:
            with np.errstate(over="ignore"):  # refused when it is written
                tensors[f"field.{name}"] = values if name == _EXACT else values.astype(np.float16)
    return tensors


def held_rows(opacity_logits: Floats, config: FieldConfig) -> NDArray[np.integer]:
    """Return which of the Gaussians a compact scene holds, at least one: those that are not too faint at all times."""
    least = CONSTANTS["ALPHA_MIN"]
    held = opacity_logits >= math.log(least / (1 - least))
    if config.appearance_size == 4:  # opacities change
        held[:] = True
    return np.flatnonzero(held) if held.any() else np.zeros(1, int)


def expand(tensors: Tensors, config: FieldConfig, sh_degree: int, where: str) -> tuple[Arrays, Arrays]:
    """Gaussians, with "static_features" where the scene moves, and field, of the tensors of a compact scene.

    Shapes are SceneFile's; the field lacks its static table. Raises InputError, whose message begins with `where`.
    """
    if config.kind != "static" and not config.decodes_on_device:
        raise InputError(f"{where}: its field {config.kind} is none that a compact scene can hold; the file is damaged")
    means = tensors.get("gaussians.means")
    count = means.shape[1] if means is not None and means.ndim == 2 else 0
    if not count:
        raise InputError(f"{where}: holds no Gaussians in its tensor 'gaussians.means'; the file is damaged")
    formats = _row_formats(config, sh_degree)
    gaussians = {name: _columns(tensors, f"gaussians.{name}", (formats[name][0], count), where) for name in formats}
    rest = np.zeros((count, 15, 3), np.float32)
    if sh_degree:
        rest[:, : (sh_degree + 1) ** 2 - 1] = gaussians["sh_rest"].reshape(count, -1, 3)
    gaussians["sh_rest"] = rest
    gaussians["sh_dc"] = gaussians["sh_dc"].reshape(count, 1, 3)
    gaussians["opacity_logits"] = gaussians["opacity_logits"].reshape(count)
    field: Arrays = {}
    starts = _table_starts(config)
    for name, shape in _field_shapes(config).items():
        if name.endswith(".table"):
            field[name] = _columns(tensors, f"field.{name}", shape[::-1], where, starts)
        else:
            code = "f4" if name == _EXACT else "f2"
            field[name] = tensor_of(tensors, f"field.{name}", shape, where, code).astype(np.float32)
    return gaussians, field


def _allowed_errors(
    stored: Mapping[str, Floats], opacity_changes: bool, look: InitialView | None
) -> dict[str, NDArray[np.floating]]:
    """Return the largest errors of a Gaussian's values that are hardly seen, (N, 1 or columns) by name."""
    means, scales = stored["means"].astype(np.float64), np.exp(stored["log_scales"].astype(np.float64))
    pixel = np.zeros((len(means), 1))  # its width at a Gaussian, where a camera about the focus is nearest
    if look is not None:
        camera, away = look.camera, np.linalg.norm(means - look.focus, axis=1, keepdims=True)
        distance = float(np.linalg.norm(camera.position - look.focus))
        pixel = np.maximum(away - distance, _NEAREST * distance) * (camera.height / camera.K[1, 1] / _PIXELS)
    shift = np.maximum(_SHIFT * np.sort(scales, axis=1)[:, 1:2], _SHIFT_PIXELS * pixel)
    ratio = CONSTANTS["DILATION"] * (pixel / scales) ** 2
    opacity = 0.5 + 0.5 * np.tanh(0.5 * stored["opacity_logits"].astype(np.float64))
    logit = _OPACITY / (np.maximum(opacity, _FAINT) * (1 - opacity + 1e-9))
    color = np.abs(0.5 + CONSTANTS["SH_C0"] * stored["sh_dc"].astype(np.float64))
    return {
        "means": shift,
        "quats": np.maximum(_TURN * scales.min(axis=1, keepdims=True), 4 * pixel) / scales.max(axis=1, keepdims=True),
        "log_scales": 0.5 * np.log1p(_WIDENING * (1 + ratio)),
        "opacity_logits": np.minimum(logit, 4 * _OPACITY) if opacity_changes else logit,
        "sh_dc": _COLOR / CONSTANTS["SH_C0"] * np.maximum(color, 1),
        "sh_rest": np.array([[_HARMONIC]]),
    }


def _table_starts(config: FieldConfig) -> list[int]:
    grids = temporal_grids(config)
    return [level.first for level in grids[0].levels] if grids else [0]


def tensor_of(tensors: Tensors, name: str, shape: tuple[int, ...], where: str, *codes: str) -> Array:
    """Return a tensor of a file, of a type with one of these codes, if there are any. Raises InputError."""
    array = tensors.get(name)
    if array is None:
        raise InputError(f"{where}: has no tensor {name!r}; the file is damaged, or of another version")
    if array.shape != shape or (codes and array.dtype.str[1:] not in codes):
        types = " or ".join(np.dtype(code).name for code in codes)
        raise InputError(
            f"{where}: tensor {name!r} has shape {array.shape} and type {array.dtype}, but the scene needs {shape} "
            f"{types}; the file is damaged"
        )
    return array


def _columns(tensors: Tensors, name: str, shape: tuple[int, ...], where: str, starts: Sequence[int] = (0,)) -> Floats:
    """Return a dequantized tensor (rows, columns). shape: (columns, rows)."""
    whole = tensor_of(tensors, name, shape, where, "u1", "u2", "f4")
    ranges = tensor_of(tensors, f"{name}.range", (len(starts), shape[0], 2), where, "f4")
    places, exact = np.zeros(0, np.uint32), np.zeros(0, np.float32)
    if f"{name}.outliers" in tensors:
        size = (tensors[f"{name}.outliers"].size,)
        places = tensor_of(tensors, f"{name}.outliers", size, where, "u4")
        exact = tensor_of(tensors, f"{name}.exact", size, where, "f4")
    if (places[-1:] >= whole.size).any() or (places[1:] <= places[:-1]).any():
        raise InputError(
            f"{where}: tensor '{name}.outliers' does not count places from 0 to {whole.size - 1} in ascending order; "
            "the file is damaged"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        values = dequantize(Quantized(whole, ranges, places, exact), starts)
    if not np.isfinite(values).all():
        raise InputError(f"{where}: tensor {name!r} has a range beyond float32; the file is damaged")
    return values
