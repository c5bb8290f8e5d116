"""Gaussians in a .ply file in the layout of 3DGS (Inria), which every splat viewer opens.

Each Gaussian is a binary little-endian row of parameters before their activations (docs/format.md). Properties are
found by name, since other programs use other orders and add properties.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.ply_elements import Element, Floats, PathLike, PlyFile

MAX_LOG_SCALE = 44.0  # exp(2 * 44) still fits in float32: the variance is finite
ANTIALIASED = "SplatRenderMode: mip"  # comment of files whose Gaussians are drawn antialiased


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
    antialiased: bool = False,
    trailer: str = "",
    buffers: Sequence[bytes | memoryview] = (),
) -> None:
    """Write Gaussians with exactly the 62 properties of 3DGS, SH padded with zeros to degree 3. Atomic.

    antialiased: adds the comment by which Brush and others tell how Gaussians are drawn. trailer: lines that declare
    a further element, whose rows are the buffers. Raises InputError when the file cannot be written or a value could
    not be read back.
    """
    rows = _vertex_rows(still, path)
    properties = "".join(f"property float {name}\n" for name in _WRITTEN_NAMES)
    comment = f"comment {ANTIALIASED}\n" if antialiased else ""
    # Some viewers expect the count on the third line.
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(still)}\n{properties}{comment}{trailer}"
    with atomic_write(path) as file:
        file.write(f"{header}end_header\n".encode())
        for buffer in (rows.data, *buffers):
            file.write(buffer)


def _vertex_rows(still: GaussianSnapshot, path: PathLike) -> Floats:
    """(N, 62) little-endian rows as in 3DGS. path: for errors. Raises InputError if they could not be read back."""
    if len(still) == 0:
        raise InputError(f"{path}: not written, because it would hold 0 Gaussians; at least 1 is needed")
    rest = still.sh.shape[1] - 1
    rows = np.zeros((len(still), 62), "<f4")  # 3:6 are the normals, which 3DGS leaves at 0
    rows[:, 0:3] = still.means
    rows[:, 6:9] = still.sh[:, 0]
    for channel in range(3):  # channel-major: all of red, then green, then blue
        rows[:, 9 + 15 * channel :][:, :rest] = still.sh[:, 1:, channel]
    rows[:, 54] = still.opacity_logits
    rows[:, 55:58] = still.log_scales
    rows[:, 58:62] = still.quats
    _check_values(rows, _WRITTEN_NAMES, f"{path}: not written, because")
    return rows


def read_gaussians(ply: PlyFile) -> GaussianSnapshot:
    """The Gaussians of an opened checkpoint: properties in any order, SH degree 0 to 3, further scalar ones skipped.

    Takes memory for about twice the Gaussians. Raises InputError when the file is not such a file, is damaged, or holds
    a value that cannot be rendered.
    """
    vertex = vertex_of(ply)
    names = gaussian_names(vertex, set(vertex.properties), ply.path)
    return snapshot_of(ply.columns(vertex, names), names, ply.path)


def vertex_of(ply: PlyFile) -> Element:
    """The element that holds Gaussians. Raises InputError where there is none."""
    if "vertex" not in ply.elements:
        raise InputError(f"{ply.path}: has no element vertex, so it holds no Gaussians; give a 3DGS .ply file")
    return ply.elements["vertex"]


def snapshot_of(values: Floats, names: list[str], path: PathLike) -> GaussianSnapshot:
    """The Gaussians of columns (N, len(names)) in the order of `gaussian_names`. Raises InputError as above."""
    _check_values(values, names, f"{path}:")
    rest = len(names) - len(_names(0))
    parts = np.split(values, np.cumsum([3, 3, rest, 1, 3]), axis=1)
    means, dc, others, opacities, scales, quats = map(np.ascontiguousarray, parts)
    sh = np.empty((len(values), 1 + rest // 3, 3), np.float32)
    sh[:, 0] = dc
    sh[:, 1:] = others.reshape(len(values), 3, rest // 3).transpose(0, 2, 1)  # channel-major in the file
    return GaussianSnapshot(means, sh, opacities[:, 0], scales, quats)


def gaussian_names(vertex: Element, known: set[str], path: PathLike) -> list[str]:
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


def problems(values: Floats, names: list[str]) -> Iterator[tuple[NDArray[np.bool_], str]]:
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
    for bad, what in problems(values, names):
        if bad.any():
            raise InputError(
                f"{where} {what} in {np.count_nonzero(bad)} of {len(bad)} rows, first in row {np.flatnonzero(bad)[0]} "
                "(counted from 0); the file is damaged or its training diverged"
            )
