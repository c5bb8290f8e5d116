"""Gaussians in a .ply file in the layout of 3DGS (Inria), which every splat viewer opens.

Each Gaussian is a binary little-endian row of parameters before their activations (docs/format.md). Properties are
found by name, since other programs use other orders, and leave out and add properties.
"""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.ply_elements import BAD_SHARE, SH_C0, Element, Floats, PathLike, PlyFile, read_colors

MAX_LOG_SCALE = 44.0  # exp(2 * 44) still fits in float32: the variance is finite
_MOTION = re.compile(  # words of a property's name that speak of time or of motion
    "(.*_)?(trbf|motion|omega|velocity|vel|v[xyz]|rot_r|t|time|timestamp|duration|lifetime|poly|fourier|traj|deform|temporal)"
    "(_.*)?",
    re.IGNORECASE,
)
_FLAT = float(np.log(1e-7))  # log of the smallest scale that is drawn
_SCALES, _UNTURNED = {"scale_0", "scale_1", "scale_2"}, {"rot_0": 1.0, "rot_1": 0.0, "rot_2": 0.0, "rot_3": 0.0}


@dataclass(frozen=True, eq=False)
class GaussianSnapshot:
    """N Gaussians at one time as stored, before the activations. All arrays are float32.

    means: (N, 3) world units. sh: (N, K, 3) spherical harmonics, K = (degree + 1)^2 coefficients, degree 0 to 3.
    opacity_logits: (N,), opacity = sigmoid. log_scales: (N, 3), standard deviation in world units = exp.
    quats: (N, 4) wxyz, any non-zero length.
    """

    means: Floats
    sh: Floats
    opacity_logits: Floats
    log_scales: Floats
    quats: Floats

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return int(self.sh.shape[1] ** 0.5) - 1


def _names(rest: int) -> list[str]:
    """Names of the read properties in the order of 3DGS, with `rest` values of SH above degree 0 (all channels)."""
    return [
        "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip


_WRITTEN_NAMES = [*_names(0)[:3], "nx", "ny", "nz", *_names(45)[3:]]


def write_ply(
    path: PathLike,
    still: GaussianSnapshot,
    *,
    antialiased: bool | float = False,
    trailer: str = "",
    buffers: Sequence[bytes | memoryview] = (),
) -> None:
    """Write Gaussians with exactly the 62 properties of 3DGS, SH padded with zeros to degree 3. Atomic.

    antialiased: adds the comment by which Brush and others tell how Gaussians are drawn, and a second one where it is a
    variance. trailer: lines that declare a further element, whose rows are the buffers. Raises InputError when the file
    cannot be written or a value could not be read back.
    """
    n, rest = len(still), still.sh.shape[1] - 1
    if n == 0:
        raise InputError(f"{path}: not written, because it would hold 0 Gaussians; at least 1 is needed")
    rows = np.zeros((n, 62), "<f4")  # 3DGS leaves the normals at 0
    means, _, dc, others, opacities, scales, quats = np.split(rows, np.cumsum([3, 3, 3, 45, 1, 3]), axis=1)
    means[:], dc[:], scales[:], quats[:] = still.means, still.sh[:, 0], still.log_scales, still.quats
    opacities[:, 0] = still.opacity_logits
    others.reshape(n, 3, 15)[:, :, :rest] = still.sh[:, 1:].transpose(0, 2, 1)  # all of red, then green, then blue
    _check_values(rows, _WRITTEN_NAMES, f"{path}: not written, because")
    properties = "".join(f"property float {name}\n" for name in _WRITTEN_NAMES)
    comment = "comment SplatRenderMode: mip\n" if antialiased else ""
    comment += f"comment LowPass: {antialiased}\n" if antialiased and antialiased is not True else ""
    # Some viewers expect the count on the third line.
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}{comment}{trailer}"
    with atomic_write(path) as file:
        file.write(f"{header}end_header\n".encode())
        for buffer in (rows.data, *buffers):
            file.write(buffer)


def read_gaussians(ply: PlyFile) -> GaussianSnapshot:
    """The Gaussians of an opened checkpoint: properties in any order, SH degree 0 to 3, further scalar ones skipped.

    Takes memory for about twice the Gaussians. Raises InputError where it is none, or a value cannot be rendered.
    """
    vertex = vertex_of(ply)
    names = _column_names(vertex, set(vertex.properties), ply.path)
    return _snapshot(ply.columns(vertex, names), names, ply.path)


def read_foreign(ply: PlyFile) -> tuple[GaussianSnapshot, dict[str, str]]:
    """The Gaussians of a 3DGS .ply of any program, and as metadata what else it says. Notes go to stderr.

    Metadata: `antialiased` is "true", or the variance of the filter, px², where comments say so; `up`, an axis such as
    "z" or "-y", is the comment's vertical axis; `offset` is a JSON list of 3 numbers, which were taken off the means.

    Degree 0 may be given as colors; the third scale of flat Gaussians, or two scales and the quaternion of spherical
    ones, may be missing. An infinite opacity is opaque, or leaves the Gaussian out; a scale of 0 is flat; a quaternion
    of 0 does not turn. A few rows that cannot be rendered are left out. Raises InputError for all else that
    `read_gaussians` refuses, and for Gaussians that move.
    """
    vertex = vertex_of(ply)
    moving = [name for name in vertex.properties if _MOTION.fullmatch(name)]
    if moving:
        raise InputError(
            f"{ply.path}: its Gaussians move (properties {', '.join(moving[:5])}, {len(moving)} in all), as in "
            "Spacetime Gaussians, of which no still is read; lapgs-view plays those with a cubic motion"
        )
    held, missing = set(vertex.properties), dict[str, Floats | float]()
    scales = held & _SCALES
    if scales == {"scale_0", "scale_1"}:
        missing["scale_2"] = _FLAT
    elif scales == {"scale_0"}:
        missing |= dict.fromkeys(("scale_1", "scale_2"), ply.columns(vertex, ["scale_0"])[:, 0])
        if not held & set(_UNTURNED):
            missing |= _UNTURNED
    if not held & {"f_dc_0", "f_dc_1", "f_dc_2"} and "opacity" in held:
        colors = read_colors(ply, vertex)
        if colors is not None:
            missing |= {f"f_dc_{i}": (colors[:, i] - 0.5) / np.float32(SH_C0) for i in range(3)}
    names = _column_names(vertex, held | set(missing), ply.path)
    unused = [name for name in vertex.properties if name not in (*names, "nx", "ny", "nz", "red", "green", "blue")]
    if unused:
        _note(ply.path, f"{len(unused)} further properties, such as {', '.join(unused[:5])}, are not used")
    values = ply.columns(vertex, [name for name in names if name not in missing])
    for index, name in enumerate(names):
        if name in missing:
            values = np.insert(values, index, missing[name], axis=1)
    metadata, text = {}, "\n".join(ply.comments)
    if re.search(r"SplatRenderMode\s*[:=]\s*mip", text, re.IGNORECASE):
        low_pass = re.search(r"LowPass: ([\d.e-]+)$", text, re.MULTILINE)
        metadata["antialiased"] = low_pass[1] if low_pass else "true"
    axis = re.search(r"(?:vertical|up)[ _]?axis\s*[:=]\s*\+?(-?[xyz])\b", text, re.IGNORECASE)
    if axis:
        metadata["up"] = axis[1].lower()
    middle, extent = _middle_and_extent(values[:, :3].astype(np.float64))
    if np.abs(middle).max() > 100 * extent:  # far from the origin
        means = ply.columns(vertex, ["x", "y", "z"], np.float64)  # in float32 they are terraces
        middle, extent = _middle_and_extent(means)
        if extent > 0:
            offset = np.round(middle, max(0, -int(np.floor(np.log10(extent)))))
            with np.errstate(over="ignore"):
                values[:, :3] = means - offset
            metadata["offset"] = json.dumps(offset.tolist())
            _note(ply.path, f"lies far from the origin: {offset.tolist()} is taken off all coordinates")
    return _snapshot(_mended(values, names, ply.path), names, ply.path), metadata


def vertex_of(ply: PlyFile) -> Element:
    """The element that holds Gaussians. Raises InputError where there is none."""
    if "vertex" not in ply.elements:
        raise InputError(f"{ply.path}: has no element vertex, so it holds no Gaussians; give a 3DGS .ply file")
    return ply.elements["vertex"]


def _snapshot(values: Floats, names: list[str], path: PathLike) -> GaussianSnapshot:
    """The Gaussians of columns (N, len(names)) in the order of `_column_names`. Raises InputError as above."""
    _check_values(values, names, f"{path}:")
    rest = len(names) - len(_names(0))
    parts = np.split(values, np.cumsum([3, 3, rest, 1, 3]), axis=1)
    means, dc, others, opacities, scales, quats = map(np.ascontiguousarray, parts)
    sh = np.empty((len(values), 1 + rest // 3, 3), np.float32)
    sh[:, 0] = dc
    sh[:, 1:] = others.reshape(len(values), 3, rest // 3).transpose(0, 2, 1)  # channel-major in the file
    return GaussianSnapshot(means, sh, opacities[:, 0], scales, quats)


def _column_names(vertex: Element, known: set[str], path: PathLike) -> list[str]:
    """Names of all columns that Gaussians need, in the order of 3DGS.

    known: properties that the file has, or that follow from others. Raises InputError unless these are complete.
    """
    properties = vertex.properties
    if "packed_position" in properties:
        raise InputError(
            f"{path}: is in PlayCanvas's compressed layout (property packed_position), which is not read; "
            "convert it to an uncompressed .ply first, for example with SuperSplat or splat-transform"
        )
    rest = sum(name.startswith("f_rest_") for name in properties)
    if rest not in (0, 9, 24, 45):
        raise InputError(
            f"{path}: has {rest} properties f_rest_*, where spherical harmonics of degree 0 to 3 have 0, 9, 24 or 45; "
            "export it with one of these degrees"
        )
    names = _names(rest)
    missing = [name for name in names if name not in known]
    if missing:
        raise InputError(
            f"{path}: its element vertex has {len(properties)} properties and lacks {len(missing)} of 3DGS, such as "
            f"{', '.join(missing[:5])}; export it with all (a cloud of points is not shown, a training may start at it)"
        )
    if vertex.count == 0:
        raise InputError(f"{path}: holds 0 Gaussians; at least 1 is needed")
    return names


def _problems(values: Floats, names: list[str]) -> Iterator[tuple[NDArray[np.bool_], str]]:
    """Rows (N,) of values (N, len(names)) that cannot be rendered, and why: those not finite once activated."""
    finite = np.isfinite(values)
    for column in np.flatnonzero(~finite.all(axis=0)):
        yield ~finite[:, column], f"property {names[column]} is NaN or infinite"
    for name, column in zip(names[-7:-4], values.T[-7:-4], strict=True):
        yield column > MAX_LOG_SCALE, f"property {name} (log scale) is over {MAX_LOG_SCALE:g}"
    with np.errstate(over="ignore", under="ignore"):
        squared_length = np.square(values[:, -4:]).sum(axis=1)
    unusable = ~np.isfinite(squared_length) | (squared_length == 0)
    yield unusable, "the quaternion rot_0..3 has a length that cannot be normalised in float32"


def _check_values(values: Floats, names: list[str], where: str) -> None:
    """Raises InputError where rows cannot be rendered."""
    for bad, what in _problems(values, names):
        if bad.any():
            raise InputError(
                f"{where} {what} in {np.count_nonzero(bad)} of {len(bad)} rows, first in row {np.flatnonzero(bad)[0]} "
                "(counted from 0); the file is damaged or its training diverged"
            )


def _note(path: PathLike, text: str) -> None:
    print(f"note: {path}: {text}.", file=sys.stderr)


def _middle_and_extent(means: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Median (3,) of means (N, 3), and the longest side of the box around nine tenths of them; 0 of no finite ones."""
    finite = means[np.isfinite(means).all(axis=1)]
    if not len(finite):
        return np.zeros(3), 0.0
    low, middle, high = np.quantile(finite, [0.05, 0.5, 0.95], axis=0)
    return middle, float((high - low).max())


def _mended(values: Floats, names: list[str], path: PathLike) -> Floats:
    """Replace in columns what is legal and cannot be rendered as it is, and leave out rows."""
    opacities, scales, quats = values[:, -8], values[:, -7:-4], values[:, -4:]
    invisible = opacities == -np.inf
    opacities[opacities == np.inf] = 20.0  # its sigmoid is 1 in float32
    scales[scales == -np.inf] = _FLAT
    quats[(quats == 0).all(axis=1)] = [1, 0, 0, 0]
    bad = np.zeros(len(values), bool)
    for rows, _ in _problems(values, names):
        bad |= rows & ~invisible
    if bad.mean() > BAD_SHARE:
        return values  # refused as a whole
    if bad.any():
        _note(path, f"{bad.sum()} of {len(bad)} Gaussians hold NaN, infinite or enormous values and are left out")
    if invisible.all():
        raise InputError(f"{path}: no Gaussian is visible (property opacity is minus infinity in all {len(bad)} rows)")
    kept = ~(bad | invisible)
    return values if kept.all() else values[kept]
