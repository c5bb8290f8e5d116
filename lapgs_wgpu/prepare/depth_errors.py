"""How far the ways of places through a film are from those of still points, at the depth that fits each best."""

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.masks import Mask
from lapgs_wgpu.prepare.poses import Floats, Plane

FEWEST = 2  # images around one, in which a place must be followed
MOST = 30.0  # times the noise: larger errors are equal
Values = NDArray[np.floating]


def depth_errors(
    ray: Floats, seen: Floats, relative: Floats, sigma: Floats, most: float, *, even: bool = False
) -> tuple[Floats, Floats]:
    """How far still points miss their ways: (n,) of all images together and (k, n) of each, in times the noise.

    ray: (n, 2) directions x / z, y / z in one image. seen: (k, n, 2) in others, NaN where unknown. relative:
    (k, 4, 4) from the one to each other. sigma: (k,) noise of `seen`. The inverse depth, from 0 to `most`, is
    fitted robustly. even: without what changes evenly over an image (`_even_errors`). NaN where less than FEWEST images
    know a place.
    """
    deep, seen = np.concatenate([ray, np.ones((len(ray), 1))], axis=1), seen.astype(np.float32)
    far = (deep @ relative[:, :3, :3].transpose(0, 2, 1)).astype(np.float32)  # of a point at infinity
    move, sigma = relative[:, None, :3, 3].astype(np.float32), sigma.astype(np.float32)
    known: Mask = np.asarray(np.isfinite(seen).all(axis=2))
    seen = np.where(known[..., None], seen, 0.0)
    total, error, off = _fitted_errors(far, move, seen, known, sigma, most)
    if even:
        seen = seen + _even_errors(ray, off, known, sigma)
        total, error, _ = _fitted_errors(far, move, seen, known, sigma, most)
    return np.where(known.sum(axis=0) >= FEWEST, total, np.nan), np.where(known, error, np.nan)


def _fitted_errors(
    far: Plane, move: Plane, seen: Values, known: Mask, sigma: Values, most: float
) -> tuple[Floats, Floats, Floats]:
    """The errors of `depth_errors`, and (k, n, 2) the last ones themselves."""
    a = move[..., :2] - seen * move[..., 2:]  # b + inverse depth * a = 0, up to depth
    b = far[..., :2] - seen * far[..., 2:]
    weight, count = known / sigma[:, None] ** 2, known.shape[1]
    inverse, total, error = np.zeros(count, np.float32), np.full(count, np.inf), np.zeros(known.shape)
    for step in range(5):
        if step:  # the first looks at points at infinity
            z = np.maximum(far[..., 2] + inverse * move[..., 2], 1e-3)
            w = (weight / z**2 / (1.0 if step == 1 else 1 + np.square(error / 2)))[..., None]
            inverse = np.clip(-(w * a * b).sum(axis=(0, 2)) / np.maximum((w * a * a).sum(axis=(0, 2)), 1e-12), 0, most)
        at = far + inverse[:, None] * move
        off = at[..., :2] / np.maximum(at[..., 2:], 1e-3) - seen
        error = np.linalg.norm(off, axis=2) / sigma[:, None]
        squares = np.square(np.minimum(error, MOST)) * known
        total = np.minimum(total, np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)))
    return total, error, off


def _even_errors(ray: Floats, off: Floats, known: Mask, sigma: Floats) -> Floats:
    """(k, n, 2) what a quadratic function of the direction, fitted robustly, says of errors `off` (k, n, 2)."""
    x, y = np.nan_to_num(ray / np.nanmax(np.abs(ray))).T
    terms, result = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1), np.zeros_like(off)
    some = slice(None, None, 4)
    for k in range(len(off)):
        factors, own, there = np.zeros((6, 2)), known[k, some], off[k, some]
        for _ in range(8 if own.any() else 0):
            left = np.linalg.norm(there - terms[some] @ factors, axis=1) / sigma[k]
            weight = own / np.square(1 + np.square(left / (2 * max(1.0, np.quantile(left[own], 0.25)))))
            weighted = (terms[some] * weight[:, None]).T
            factors = np.linalg.solve(weighted @ terms[some] + 1e-6 * np.eye(6), weighted @ there)
        result[k] = terms @ factors
    return result
