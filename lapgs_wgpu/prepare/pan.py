"""Rotations of a camera that turns on the spot, and its lens, by the matches of its images: no depth enters.

Bundle adjustment of rotations (Brown and Lowe, "Automatic panoramic image stitching", 2007) with a robust loss, from
rotations that are chained through the film. What moves stays unexplained, and what is near where the camera walks.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.data.images import Size
from lapgs_wgpu.prepare.poses import Floats, Ints, Match, Plane

MATCHES = 40  # of a pair of images
SIGMA = 1.5e-3  # of the longer side: residual from which on a match counts little
FIT = 2.5e-3  # of the longer side: a match up to this residual is explained
FAR = 6  # images apart: near images of a camera that walks look turned, too


class Pan(NamedTuple):
    """rotations: (n, 3, 3), world to camera (x right, y down). focal: pixels. radial: first coefficient.
    explained: share of the matches of images at least FAR apart (of all, in a shorter film). travel: pixels that the
    middle of the image moves between two images at most."""

    rotations: Floats
    focal: float
    radial: float
    explained: float
    travel: float


def solve_pan(
    names: Sequence[str], places: Mapping[str, Plane], matches: Match, size: Size, focal: float
) -> Pan | None:
    """The rotations that explain most matches, None where images share none. focal: a first guess, pixels.

    places: (n, 2 or more) of the features of each image, pixels. size: (width, height) of the images.
    """
    if sum(len(m) for m in matches.values()) < 8 * len(names):
        return None
    rng, parts = np.random.default_rng(0), []
    for pair, m in matches.items():
        m = m[rng.permutation(len(m))[:MATCHES]]
        ends = [places[name][m[:, i], :2] - np.array(size) / 2 for i, name in enumerate(pair)]
        parts.append((np.tile([names.index(name) for name in pair], (len(m), 1)), np.stack(ends, axis=1)))
    pairs, at = map(np.concatenate, zip(*parts, strict=True))
    sigma = SIGMA * max(size)
    chained = _chained(pairs, at, len(names), focal, sigma)
    rotations, focal, radial, error = _refined(pairs, at, chained, focal, sigma)
    far = pairs[:, 1] - pairs[:, 0] >= FAR
    fits = error < FIT * max(size)
    axes = rotations[:, 2]
    turn = float(np.arccos(np.clip((axes @ axes.T).min(), -1, 1)))
    explained = float(fits[far].mean() if far.sum() > 100 else fits.mean())
    return Pan(rotations, focal, radial, explained, focal * turn)


def rays(places: Floats, focal: float, radial: float) -> Floats:
    """(m, 3) directions of places (m, 2) in pixels from the middle of the image; their depth is 1."""
    bent = flat = places / focal
    for _ in range(5):  # r = f u (1 + k u^2), solved for u
        flat = bent / np.maximum(1 + radial * np.square(flat).sum(axis=1, keepdims=True), 0.2)
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)


def _residuals(pairs: Ints, at: Floats, R: Floats, focal: float, radial: float) -> tuple[Floats, Floats, Floats]:
    """Rays in the first image (m, 3), the same seen by the second one, and pixels (m, 2) from where they are.

    pairs: (m, 2) numbers of the two images of each match, the earlier one first. at: (m, 2, 2) its places in both,
    pixels from the middle of the image.
    """
    ray = rays(at[:, 0], focal, radial)
    seen = np.einsum("mij,mj->mi", R[pairs[:, 1]] @ R[pairs[:, 0]].transpose(0, 2, 1), ray)
    flat = seen[:, :2] / np.maximum(seen[:, 2:], 1e-3)
    return ray, seen, focal * flat * (1 + radial * np.square(flat).sum(axis=1, keepdims=True)) - at[:, 1]


def _chained(pairs: Ints, at: Floats, count: int, focal: float, sigma: float) -> Floats:
    """(n, 3, 3) rotations, each from one of the 3 before, of least sum of distances (Kabsch 1976, reweighted)."""
    rotations = np.tile(np.eye(3), (count, 1, 1))
    for image in range(1, count):
        rotations[image] = rotations[image - 1]
        for before in range(image - 1, max(-1, image - 4), -1):
            both = np.flatnonzero((pairs == [before, image]).all(axis=1))
            if len(both) < 8:
                continue
            one, other = (rays(at[both, end], focal, 0.0) for end in (0, 1))
            one, other = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (one, other))
            turn, weight = np.eye(3), np.ones(len(both))
            for _ in range(12):
                U, _, Vt = np.linalg.svd((weight[:, None] * other).T @ one)
                turn = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
                weight = 1 / np.maximum(np.linalg.norm(other - one @ turn.T, axis=1), sigma / focal)
            rotations[image] = turn @ rotations[before]
            break
    return rotations


def _refined(pairs: Ints, at: Floats, R: Floats, focal: float, sigma: float) -> tuple[Floats, float, float, Floats]:
    """Levenberg-Marquardt with the loss e / (1 + e), e = (residual / sigma)^2. Returns rotations, focal length, radial
    coefficient and the residuals (m,) in pixels."""
    from scipy.sparse import csr_array  # slow to import
    from scipy.spatial.transform import Rotation

    n, radial, damping = len(R), 0.0, 1e-3
    ray, seen, r = _residuals(pairs, at, R, focal, radial)
    turns = 3 * pairs[:, :, None] + np.arange(3)
    columns = np.column_stack([turns.reshape(-1, 6), np.tile([3 * n, 3 * n + 1], (len(r), 1))]).repeat(2, axis=0)

    def cost(r: Floats) -> float:
        e = np.square(r).sum(axis=1) / sigma**2
        return float((e / (1 + e)).sum())

    now = cost(r)
    for _ in range(30):
        weight = 1 / (1 + np.square(r).sum(axis=1) / sigma**2)  # square root of the loss's slope
        inverse = 1 / np.maximum(seen[:, 2], 1e-3)
        by_point = np.zeros((len(r), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = focal * inverse
        by_point[:, :, 2] = -focal * seen[:, :2] * inverse[:, None] ** 2
        by_focal = (_residuals(pairs, at, R, focal * 1.0001, radial)[2] - r) / 1e-4  # of its logarithm
        by_radial = (_residuals(pairs, at, R, focal, radial + 1e-4)[2] - r) / 1e-4
        by_a = np.cross(by_point @ (R[pairs[:, 1]] @ R[pairs[:, 0]].transpose(0, 2, 1)), ray[:, None])
        by_b = np.cross(seen[:, None], by_point)
        rows = np.concatenate([by_a, by_b, by_focal[:, :, None], by_radial[:, :, None]], axis=2) * weight[:, None, None]
        J = csr_array((rows.ravel(), columns.ravel(), np.arange(0, rows.size + 1, 8)), shape=(2 * len(r), 3 * n + 2))
        H, gradient = (J.T @ J).toarray(), J.T @ (r * weight[:, None]).ravel()
        H[:3], H[:, :3], gradient[:3] = 0, 0, 0  # the first image stays
        H[range(3), range(3)] = 1
        H[-1, -1] += 1e3  # a lens without distortion, unless the matches say otherwise
        gradient[-1] += 1e3 * radial
        H[range(len(H)), range(len(H))] += 1e-6  # images without matches
        for _ in range(6):
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
            tried = Rotation.from_rotvec(step[:-2].reshape(n, 3)).as_matrix() @ R
            lens = focal * float(np.exp(np.clip(step[-2], -0.3, 0.3))), radial + float(step[-1])
            result = _residuals(pairs, at, tried, *lens)
            gain = now - cost(result[2])
            if gain > 0:
                break
            damping *= 8
        else:
            break
        (focal, radial), R, (ray, seen, r) = lens, tried, result
        now, damping = now - gain, max(damping / 4, 1e-7)
        if gain < 1e-5 * now:
            break
    return R, focal, radial, np.linalg.norm(r, axis=1)
