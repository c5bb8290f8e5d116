"""The motion of a playback as pieces of straight lines, for files that hold no field.

A piece is halved until a line and one shape, color and opacity are near enough to all that the field says of it.
Shapes are compared by the square roots of their covariances, whose columns lie on the ellipsoid of one standard
deviation: unlike quaternions they do not turn where the ellipsoid looks the same.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.motion.playback.playback import Playback
from lapgs_wgpu.splat.camera import rotation_matrix
from lapgs_wgpu.splat.constants import CONSTANTS

Floats = NDArray[np.floating]

_SAMPLES = 128  # of the clip at least; a field's spectrum has up to 16 cycles
_PIECE_SAMPLES = 8  # of a piece at least
_SHORTEST = 2.0**-9  # of the clip: shorter pieces are not halved
_BLOCK = 1 << 21  # samples at once: 0.1 GB
_MEAN, _ROOT, _REST = slice(0, 3), slice(3, 9), slice(9, 13)  # columns of a state: mean, root; opacity and color
_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # entries of a root
_WEIGHTS = np.array([1, 1, 1, 2, 2, 2]) ** 0.5  # so that the norm of the six is that of the matrix


class Pieces(NamedTuple):
    """P pieces, in ascending order of (source, begin).

    source: (P,) number of the Gaussian. begin, end: (P,) in [0, 1] of the clip. means: (P, 3) at the middle, world
    units. slopes: (P, 3) world units a clip. scales: (P, 3). quats: (P, 4) xyzw. opacities: (P,). dc: (P, 3)
    harmonics of degree 0.
    """

    source: NDArray[np.integer]
    begin: Floats
    end: Floats
    means: Floats
    slopes: Floats
    scales: Floats
    quats: Floats
    opacities: Floats
    dc: Floats


def linear_pieces(playback: Playback, farthest: float, shade: float, done: Callable[[float], object]) -> Pieces:
    """Bake a playback. Gaussians that no pass draws during a piece are left out of it.

    farthest: largest distance, at the samples, of a point of an ellipsoid of one standard deviation from where the
    playback has it, world units. shade: largest change of opacity and color within a piece, both in [0, 1]. done:
    called with the share that is done, now and then.
    """

    def halve(values: Floats, rows: NDArray[np.integer], begin: float, end: float) -> Iterator[tuple[Floats, ...]]:
        """Yield (source, begin, end, state at the middle, slope) of pieces. values: (samples, rows, 13), evenly."""
        at = np.linspace(-0.5, 0.5, len(values), dtype=np.float32)[:, None, None]
        middle = values.mean(axis=0)
        slope = (at * values[..., _MEAN]).sum(axis=0) / (at**2).sum()
        guess = np.broadcast_to(middle, values.shape).copy()
        guess[..., _MEAN] += at * slope
        near = (displacement(guess, values) <= farthest).all(axis=0)
        near &= (np.abs(guess - values)[..., _REST] <= shade).all(axis=(0, 2))
        near |= end - begin <= _SHORTEST
        seen = near & (values[..., 9].max(axis=0) >= CONSTANTS["ALPHA_MIN"])
        count = int(seen.sum())
        yield rows[seen], np.full(count, begin), np.full(count, end), middle[seen], slope[seen] / (end - begin)
        if near.all():
            return
        values, rows, half, cut = values[:, ~near], rows[~near], len(values) // 2, 0.5 * (begin + end)
        for part, span in ((values[: half + 1], (begin, cut)), (values[half:], (cut, end))):
            yield from halve(_sampled(playback, part, rows, *span), rows, *span)

    found: list[tuple[Floats, ...]] = []
    size = _BLOCK // _SAMPLES
    for first in range(0, playback.count, size):
        block = np.arange(first, min(first + size, playback.count))
        values = np.stack([state(playback, t, block) for t in np.linspace(0, 1, _SAMPLES + 1).tolist()])
        for piece in halve(values, block, 0.0, 1.0):
            found.append(piece)
            done((first + len(block) * float(piece[1].max(initial=0))) / playback.count)
    source, begin, end, middle, slopes = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.lexsort((begin, source))
    middle = middle[order].astype(np.float64)
    scales, quats = _ellipsoids(middle[:, _ROOT])
    return Pieces(
        source[order], begin[order], end[order], middle[:, _MEAN], slopes[order], scales, quats,
        middle[:, 9], middle[:, 10:] / CONSTANTS["SH_C0"],
    )  # fmt: skip


def state(playback: Playback, t: float, rows: NDArray[np.integer]) -> Floats:
    """Return states (rows, 13) of Gaussians at a time: mean, root of the covariance, opacity, color of degree 0."""
    arrays = read_all(list(playback.at(t).arrays().values()))
    means, quats, scales, opacities, sh = (values[rows] for values in arrays)
    roots = roots_of(scales, np.roll(quats, -1, axis=1))
    return np.concatenate([means, roots, opacities[:, None], CONSTANTS["SH_C0"] * sh[:, 0]], axis=1)


def roots_of(scales: Floats, quats: Floats) -> Floats:
    """Return weighted entries (N, 6) of the square roots of covariances. quats: (N, 4) xyzw, of any length."""
    axes = rotation_matrix(np.roll(quats / np.linalg.norm(quats, axis=1, keepdims=True), 1, axis=1).T)
    return np.einsum("ikn,ikn,nk->ni", axes[_ROWS], axes[_COLUMNS], scales) * _WEIGHTS


def displacement(moved: Floats, true: Floats) -> Floats:
    """Return a bound (...,) of how far points of ellipsoids of one standard deviation are apart, world units."""
    means = np.linalg.norm(moved[..., _MEAN] - true[..., _MEAN], axis=-1)
    return means + np.linalg.norm(moved[..., _ROOT] - true[..., _ROOT], axis=-1)


def _sampled(playback: Playback, values: Floats, rows: NDArray[np.integer], begin: float, end: float) -> Floats:
    """Return the samples of a piece, with those in between where they are too few."""
    if len(values) > _PIECE_SAMPLES:
        return values
    fine = np.empty((2 * len(values) - 1, *values.shape[1:]), values.dtype)
    fine[::2] = values
    fine[1::2] = [state(playback, t, rows) for t in np.linspace(begin, end, len(fine))[1::2].tolist()]
    return fine


def _ellipsoids(roots: Floats) -> tuple[Floats, Floats]:
    """Return scales (N, 3) and quaternions (N, 4) xyzw of roots."""
    from scipy.spatial.transform import Rotation

    matrices = np.empty((len(roots), 3, 3))
    matrices[:, _ROWS, _COLUMNS] = matrices[:, _COLUMNS, _ROWS] = roots / _WEIGHTS
    scales, axes = np.linalg.eigh(matrices)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return np.maximum(scales, CONSTANTS["MIN_SCALE"]), Rotation.from_matrix(axes).as_quat()
