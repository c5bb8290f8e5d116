"""The container `.4dgs`, version 1: Gaussians that each move along a straight line for a span of time.

An open format with a public specification (avala-ai/4dgs, Apache-2.0; "section" means one of it). Only its temporal
model `gaussian-birth` is written: a Gaussian is there from the beginning to the end of its span, in full opacity.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError

Floats = NDArray[np.floating]
Whole = NDArray[np.integer]

MAGIC = b"\x894DGS1\r\n"
SH_RANGE = 4.0  # a coefficient is a byte from -this to +this (section 6.5)
_HEADER, _FOOTER, _QUANTIZATION, _WINDOWS, _CHUNK, _SH_BAND, _INDEX, _CAMERA, _FRAME = 1, 2, 3, 4, 5, 7, 8, 10, 32
_PARTS = 8  # of the clip; a piece that reaches from one into another is in a chunk of the whole clip
_CUTOFF = 0.05  # of opacities that fade, which none of ours does
_SHORTEST, _LONGEST, _REFERENCE = 0.02, 2.0, 0.5  # seconds; of spans, for the steps of velocities (section 6.3)
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # components of a quaternion but the largest


@dataclass(frozen=True, eq=False)
class LinearPieces:
    """P pieces of the paths of Gaussians.

    source: (P,) which Gaussian, ascending. spans: (P, 2) seconds, from and until. means: (P, 3) at the middle of the
    span, world units. velocities: (P, 3) world units a second. scales: (P, 3) standard deviations, world units.
    quats: (P, 4) xyzw, unit. opacities: (P,). colors: (P, 3) linear light without the higher harmonics, in [0, 1].
    harmonics: (P, K, 3) linear light, K = (degree + 1)^2 - 1.
    """

    source: Whole
    spans: Floats
    means: Floats
    velocities: Floats
    scales: Floats
    quats: Floats
    opacities: Floats
    colors: Floats
    harmonics: Floats

    def __len__(self) -> int:
        return len(self.source)

    @property
    def middles(self) -> Floats:
        """(P,) seconds."""
        return self.spans.mean(axis=1)


class Grid(NamedTuple):
    """Steps to which values are rounded, so that none is farther off than half of one.

    mean: world units. log_scale: natural logarithm. rotation: components of a unit quaternion. color, opacity.
    velocity: world units a second, for a span of _REFERENCE seconds. time: seconds.
    """

    mean: float
    log_scale: float
    rotation: float
    color: float
    opacity: float
    velocity: float
    time: float


class Rounded(NamedTuple):
    """Pieces as whole numbers, by name of the attribute, and the values that every reader makes of them."""

    whole: dict[str, Whole]
    harmonics: NDArray[np.uint8]
    origin: Floats
    pieces: LinearPieces


def round_pieces(pieces: LinearPieces, grid: Grid) -> Rounded:
    """Round pieces to a grid. Middles of spans must lie on the grid's times."""
    origin = pieces.means.min(axis=0).astype(np.float64)
    quats = pieces.quats / np.linalg.norm(pieces.quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    quats = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -quats, quats)
    rest = np.take_along_axis(quats, _OTHERS[largest], axis=1)
    steps = grid.velocity * _velocity_factors(np.diff(pieces.spans, axis=1)[:, 0])
    red, green, blue = np.rint(pieces.colors / grid.color).astype(np.int64).T
    whole = {
        "means": _whole((pieces.means - origin) / grid.mean),
        "scales": _whole(np.log(pieces.scales) / grid.log_scale),
        "largest": largest[:, None],
        "rest": _whole(rest / grid.rotation),
        "colors": np.stack([green, red - green, blue - green], axis=1),
        "opacities": _whole(pieces.opacities[:, None] / grid.opacity),
        "velocities": _whole(pieces.velocities / steps[:, None]),
        "middles": _whole(pieces.middles[:, None] / grid.time),
    }
    rest = (whole["rest"] * grid.rotation).clip(-1, 1)
    quats = np.empty((len(pieces), 4))
    np.put_along_axis(quats, _OTHERS[largest], rest, axis=1)
    np.put_along_axis(quats, largest[:, None], np.sqrt(np.maximum(1 - (rest**2).sum(1, keepdims=True), 0)), axis=1)
    harmonics = harmonics_bytes(pieces.harmonics)
    exact = LinearPieces(
        source=pieces.source,
        spans=pieces.spans,
        means=whole["means"] * grid.mean + origin,
        velocities=whole["velocities"] * steps[:, None],
        scales=np.exp(whole["scales"] * grid.log_scale),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacities=whole["opacities"][:, 0] * grid.opacity,
        colors=np.stack([red, green, blue], axis=1) * grid.color,
        harmonics=bytes_harmonics(harmonics),
    )
    return Rounded(whole, harmonics, origin, exact)


def harmonics_bytes(coefficients: Floats) -> NDArray[np.uint8]:
    """Coefficients as bytes; those beyond SH_RANGE as its ends. No byte is zero: the smallest are 0.016 beside it."""
    return np.rint((coefficients + SH_RANGE) * (255 / (2 * SH_RANGE))).clip(0, 255).astype(np.uint8)


def bytes_harmonics(whole: NDArray[np.uint8]) -> Floats:
    """The coefficients of `harmonics_bytes`."""
    return whole * (2 * SH_RANGE / 255) - SH_RANGE


def pack_4dgs(
    rounded: Rounded,
    grid: Grid,
    seconds: float,
    *,
    camera: tuple[float, Sequence[float], Sequence[float]],
    axes: tuple[int, int] | None,
    texts: Mapping[str, str],
) -> bytes:
    """The bytes of a file.

    seconds: length of the clip. camera: vertical field of view in degrees, position, and the point that it looks at.
    axes: up and ahead as places in +x +y +z -x -y -z; None where up is none of them. texts: go into the header.
    """
    pieces = rounded.pieces
    degree = int((pieces.harmonics.shape[1] + 1) ** 0.5) - 1
    box = (*pieces.means.min(axis=0), *pieces.means.max(axis=0)) if len(pieces) else (0.0,) * 6
    windows, window = np.unique(pieces.spans, axis=0, return_inverse=True)
    rounded.whole["window"] = window.reshape(-1, 1)
    half = [step / 2 for step in grid]
    bounds = dict(zip(("pos", "scale_rel", "rot", "rgb", "alpha", "motion", "time"), half, strict=True))
    bounds |= {"scale_rel": float(np.expm1(half[1])), "sigma_rel": 0.0, "sh": 0}
    parts = [
        MAGIC,
        _record(
            _HEADER, _text(""), _text("lapgs_wgpu"), struct.pack("<dQd", seconds, len(pieces), _CUTOFF),
            _text("gaussian-birth"), struct.pack("<6dBB", *box, degree, 0), _texts(texts),
        ),
        _record(
            _QUANTIZATION, _text("uniform-v1"), struct.pack("<3d", *rounded.origin),
            struct.pack("<8dB", *grid, 1.0, 1), _texts({name: repr(float(value)) for name, value in bounds.items()}),
        ),
        _record(_WINDOWS, struct.pack("<I", len(windows)), windows.astype("<f8").tobytes()),
    ]  # fmt: skip
    if axes is not None:
        parts.append(_record(_FRAME, _text(""), struct.pack("<BBBBd", 1, *axes, 0, 0.0)))  # right-handed, of no unit
    fov, position, target = camera
    parts.append(
        _record(_CAMERA, struct.pack("<d3d3dI", fov, *position, *target, 0), _text("linear"), struct.pack("<B", 1))
    )
    at = sum(map(len, parts))
    index = []
    for begin, end, rows in _chunks(pieces.spans, seconds):
        chunk = _chunk(rounded.whole, rows, begin, end)
        bands = [_band(rounded.harmonics[rows], band) for band in range(1, degree + 1)]
        places = np.cumsum([at, len(chunk), *map(len, bands)]).tolist()
        entry = struct.pack("<ddQQII", begin, end, at, len(chunk), len(rows), degree)
        for band in range(degree):
            entry += struct.pack("<BQQ", band + 1, places[band + 1], len(bands[band]))
        index.append(_record(_INDEX, entry))
        parts += [chunk, *bands]
        at = places[-1]
    summary = b"".join(index)
    parts += [summary, _record(_FOOTER, struct.pack("<QQI", at if index else 0, 0, zlib.crc32(summary))), MAGIC]
    return b"".join(parts)


def _velocity_factors(lengths: Floats) -> Floats:
    """By which the velocity's step shrinks with the length of a span in seconds (section 6.3)."""
    return 2.0 ** -np.ceil(np.log2(lengths.clip(_SHORTEST, _LONGEST) / _REFERENCE)).clip(-4, 2)


def _chunks(spans: Floats, seconds: float) -> list[tuple[float, float, Whole]]:
    """From, until and rows of the pieces of each part of the clip, and those of the whole clip before."""
    part = np.floor(_PARTS * spans[:, 0] / seconds + 1e-9).astype(np.int64)
    part[spans[:, 1] > (part + 1 + 1e-9) * seconds / _PARTS] = -1
    found = [(number, np.flatnonzero(part == number)) for number in range(-1, _PARTS)]
    at = [(0.0, seconds), *((number * seconds / _PARTS, (number + 1) * seconds / _PARTS) for number in range(_PARTS))]
    return [(*at[number + 1], rows) for number, rows in found if len(rows)]


def _chunk(whole: Mapping[str, Whole], rows: Whole, begin: float, end: float) -> bytes:
    zeros = np.zeros((len(rows), 1), np.int64)
    names = ("means", "scales", "largest", "rest", "colors", "opacities", "velocities", "middles")
    columns = [whole[name][rows] for name in names]
    columns += [zeros, zeros + 1, whole["window"][rows]]  # no deviation in time; flag: never fades
    streams = b"".join(_stream(number, column) for number, column in enumerate(columns))
    head = struct.pack("<ddII", begin, end, 0, len(rows)) + _text("")
    return _record(_CHUNK, head, struct.pack("<QQ", len(streams), len(streams)), streams)


def _band(harmonics: NDArray[np.uint8], band: int) -> bytes:
    """All reds of a degree, then greens, then blues."""
    columns = harmonics[:, band**2 - 1 : (band + 1) ** 2 - 1].transpose(0, 2, 1).reshape(len(harmonics), -1)
    return _record(_SH_BAND, struct.pack("<B", band), _stream(_SH_BAND, columns.astype(np.int64)))


def _stream(number: int, columns: Whole) -> bytes:
    """Columns (P, C) of an attribute: as they are or as differences from row to row, whichever is shorter."""
    columns = columns.astype(np.int64)
    differences = np.diff(columns, axis=0, prepend=0)
    bodies = [_symbols(values) for values in (columns, differences)]
    mode = int(len(bodies[1][1]) < len(bodies[0][1]))
    width, body = bodies[mode]
    return struct.pack("<BBBBBIQ", number, width, mode, 0, columns.shape[1], len(columns), len(body)) + body


def _symbols(values: Whole) -> tuple[int, bytes]:
    """Bytes of each, and the deflated bytes: first the lowest of all, then the next."""
    folded = ((values << 1) ^ (values >> 63)).reshape(-1).astype(np.uint64)
    most = int(folded.max(initial=0))
    if most >= 1 << 32:
        raise InputError(
            "a .4dgs file cannot hold a Gaussian so far away at such a precision; give a larger --max-error."
        )
    width = 1 if most < 1 << 8 else 2 if most < 1 << 16 else 4
    return width, zlib.compress(folded.astype(f"<u{width}").view(np.uint8).reshape(-1, width).T.tobytes(), 9)


def _whole(values: Floats) -> Whole:
    return np.rint(values).astype(np.int64)


def _record(number: int, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<BQ", number, len(body)) + body


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _texts(texts: Mapping[str, Any]) -> bytes:
    body = b"".join(_text(name) + _text(text) for name, text in sorted(texts.items()))
    return struct.pack("<I", len(body)) + body
