"""Rotations of moving parts, estimated from their colors on a ball around each part's center.

The outline of what moves tells where the ball is. Where a part turns as assumed, images of different times agree on the
color of each place of the ball. A search finds the turn per time step on which those around a key time agree best. From
there outwards, each time turns as its image fits best what is known of the ball, near the turn that goes on as before;
then each is fitted once more to what all others show. `rigid_fit` makes it exact.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from lapgs_wgpu.data.evenly import evenly_indices
from lapgs_wgpu.data.timestamps import time_step
from lapgs_wgpu.discovery.residual import Floats, Residual, cubic_grid
from lapgs_wgpu.discovery.tracks import Tracks, parabolas
from lapgs_wgpu.splat.camera import Array

PIXELS, SAMPLES = 2000, 150  # of an image, and of a part in it, at most
LEAST_SAMPLES, LEAST_TIMES = 10, 12  # of a part in an image, and at which it is seen
RIM = 0.9  # radii of the ball; beyond, pixels are mixed with what lies behind
INSIDE = 0.75  # radii of the larger of two parts, within which the center of the other is of the same thing
OVERLAP = 1.2  # radii of a part, within which pixels may show it
DARK = 0.2  # least light, of the mean brightness
FASTEST = 36.0  # degrees a time step
# The searches, from rough to fine: degrees between turns, half of those before; time steps on either side over which
# images are compared; and how many turns the next one looks around.
SEARCHES = (8.0, 3, 12), (4.0, 5, 4), (2.0, 8, 1)
CELL, FINE = 0.18, 0.12  # radii; size of the places at which colors are compared, in the search and from there on
SIDE = int(2 / FINE) + 3  # of these along an axis
BLUR = 1.0  # FINE; standard deviation of the weights by which the colors around a place tell its color
AROUND = (6.0, 2), (2.0, 2), (1.0, 1)  # degrees of a step and number of steps, of the search for the turn of a time
AS_BEFORE = 36.0  # degrees beside the turn that goes on as before, that weigh as much as all differences of color
MEMORY = 4  # times by which a turn goes on
SPREAD, OUTLINE_SPREAD = 6.0, 2.0  # time steps; of the weights by which turns, and balls' moves, become smooth
# Share of the colors' variance that is left without turns, which the turns of a part must explain: true ones 0.28 and
# more, others 0.17 at most.
GAIN = 0.22


class _Look(NamedTuple):
    """What the images of a time show of a part: unit vectors (n, 3) from its center, and colors (n, 3)."""

    places: Array
    colors: Floats


def _joined(looks: Iterable[_Look]) -> _Look:
    return _Look(*map(np.concatenate, zip(*looks, strict=True)))


def harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """The 9 functions of unit vectors that make the light on a matt surface (Ramamoorthi and Hanrahan 2001)."""
    return [0 * x + 1, x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]


def find_turns(tracks: Tracks, times: Array, images: Sequence[Residual]) -> tuple[NDArray[np.int64], dict[int, Array]]:
    """(p,) which part stands for each, since several may be one thing; and by the number of each of these that turns
    its rotations (T, 3, 3) at the times (T,), from whatever orientation."""
    centers = [tracks.center(k) for k in range(tracks.parts)]
    radii = np.array([tracks.radius(k) for k in range(len(centers))])
    stands = _one_of_each(centers, radii)
    things = np.unique(stands)
    middles, sizes = np.stack([centers[k] for k in things], axis=1), radii[things]
    for _ in range(2):
        middles, sizes = _outlined(times, middles, sizes, images)
    clock, near = times / time_step(times), parabolas(times, 1.0, SPREAD)
    found = {}
    for n, k in enumerate(things.tolist()):
        looks = _looks(n, times, middles, sizes, images)
        if sum(len(look.places) > 0 for look in looks) < LEAST_TIMES:
            continue
        looks = _unlit(looks)
        R = _smoothed(_turns(looks, clock), clock, near)
        known = sum(map(_known, looks, R), np.zeros(()))
        again = [_turn_of(look, each, known - _known(look, each)) for look, each in zip(looks, R, strict=True)]
        R = _smoothed(np.stack(again), clock, near)
        places, colors = _joined(looks)
        variance = _variance(colors)
        still = _explained(places, colors, variance)
        turned = np.concatenate([look.places @ each for look, each in zip(looks, R, strict=True)])
        if _explained(turned, colors, variance) - still >= GAIN * (1.0 - still):
            found[k] = R
    return stands, found


def _one_of_each(centers: Sequence[Floats], radii: Array) -> NDArray[np.int64]:
    """(p,) for each part the one of the same place whose center (T, 3) bends least: what goes astray leaps."""
    stands = np.arange(len(radii))
    bends = [np.square(np.diff(center, 2, axis=0)).sum() for center in centers]
    for k in np.argsort(bends, kind="stable"):
        for other in range(len(radii)):
            apart = np.median(np.linalg.norm(centers[k] - centers[other], axis=1))
            if stands[k] == k and stands[other] == other and bends[k] < bends[other]:
                stands[other] = k if apart < INSIDE * max(radii[k], radii[other]) else other
    return stands


def _outlined(times: Array, centers: Floats, radii: Array, images: Sequence[Residual]) -> tuple[Floats, Array]:
    """Centers (T, p, 3) and radii (p,) of parts as the outlines of what moves tell, of those that stand alone and whole
    in an image. Where several images show a time, the last one tells."""
    shifts, weights = np.zeros(centers.shape), np.full(centers.shape[:2], 1e-3)
    sizes: list[list[float]] = [[] for _ in radii]
    for image in images:
        at, K, T = int(np.searchsorted(times, image.time)), image.camera.K, image.camera.T_cam_world
        middles, depths = image.camera.project(centers[at].astype(np.float64))
        reach = OVERLAP * K[0, 0] * radii / np.maximum(depths, 1e-6)
        apart = np.hypot(*(middles - middles[:, None]).T) > reach + reach[:, None]
        alone = (apart | np.eye(len(radii), dtype=bool)).all(axis=0)
        whole = ((middles > reach[:, None]) & (middles < np.array(image.mask.shape)[::-1] - reach[:, None])).all(axis=1)
        for n in np.flatnonzero(alone & whole & (depths > 0)).tolist():
            rows, columns = np.nonzero(image.moving_within(middles[n], reach[n]))
            if len(rows) < LEAST_SAMPLES:
                continue
            x, y = (np.array([columns, rows]) + 0.5).mean(axis=1) - middles[n]
            away = np.array([x / K[0, 0], y / K[1, 1], 0.0])
            shifts[at, n], weights[at, n] = depths[n] * away @ T[:3, :3], 1.0
            sizes[n].append(float(np.sqrt(len(rows) / np.pi) * depths[n] / K[0, 0]))
    moved, found = centers.copy(), radii.copy()
    for n, each in enumerate(sizes):
        if len(each) >= LEAST_TIMES:
            moved[:, n] += parabolas(times, weights[:, n], OUTLINE_SPREAD) @ shifts[:, n]
            found[n] = np.median(each)
    return moved, found


def _looks(k: int, times: Array, centers: Floats, radii: Array, images: Sequence[Residual]) -> list[_Look]:
    """What each of the times (T,) shows of part k. centers: (T, p, 3) and radii: (p,) of all parts."""
    found: list[list[_Look]] = [[_Look(np.zeros((0, 3)), np.zeros((0, 3), np.float32))] for _ in times]
    others = np.arange(len(radii)) != k
    for image in images:
        at = int(np.searchsorted(times, image.time))
        directions, _, colors = image.rays(PIXELS)
        d = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        to = centers[at] - image.camera.position
        along = d @ to.T
        beside = (to**2).sum(axis=1) - along**2  # (n, p) squared distances of rays and centers
        hidden = (beside[:, others] < (OVERLAP * radii[others]) ** 2).any(axis=1)
        chosen = np.flatnonzero((beside[:, k] < (RIM * radii[k]) ** 2) & ~hidden)
        if len(chosen) < LEAST_SAMPLES:
            continue
        chosen = chosen[evenly_indices(len(chosen), SAMPLES)]
        distances = along[chosen, k] - np.sqrt(radii[k] ** 2 - np.maximum(beside[chosen, k], 0.0))
        found[at].append(_Look((distances[:, None] * d[chosen] - to[k]) / radii[k], colors[chosen]))
    return [_joined(each) for each in found]


def _unlit(looks: list[_Look]) -> list[_Look]:
    """The colors without the light, which does not turn with a part."""
    places, colors = _joined(looks)
    basis, bright = np.stack(harmonics(*places.T), axis=1), colors.mean(axis=1)
    H = basis.T @ basis
    light = np.linalg.solve(H + 1e-3 * (np.trace(H) + 1) / 9 * np.eye(9), basis.T @ bright)
    least = DARK * float(bright.mean())
    lit = (np.maximum(np.stack(harmonics(*look.places.T), 1) @ light, least)[:, None] for look in looks)
    return [look._replace(colors=look.colors / each) for look, each in zip(looks, lit, strict=True)]


def _cells(places: Array, size: float) -> NDArray[np.int64]:
    """(...) numbers of the cells of this size, of a cubic grid of SIDE^3, in which places (..., 3) lie."""
    index = np.floor(places / size).astype(np.int64) + SIDE // 2
    return (index[..., 0] * SIDE + index[..., 1]) * SIDE + index[..., 2]


def _variance(colors: Floats) -> float:
    """Of colors (n, 3), over all channels."""
    return float(colors.var(axis=0).sum())


def _explained(places: Array, colors: Floats, variance: float, blocks: NDArray[np.int64] | int = 0) -> float:
    """Share of the variance of colors (n, 3) that places (n, 3) of size CELL explain, as if they were independent.
    blocks: (n,) from 0; only places of one block are compared."""
    cells = _cells(places, CELL) + blocks * SIDE**3
    counts = np.bincount(cells)
    used = np.flatnonzero(counts)
    rest = float(np.square(colors).sum())
    for values in colors.T:
        rest -= float((np.bincount(cells, values)[used] ** 2 / counts[used]).sum())
    return 1.0 - rest / max(len(cells) - len(used), 1) / max(variance, 1e-9)


def _turn_at(looks: list[_Look], clock: Array, key: int) -> tuple[Array, float]:
    """The turn (3,) a time step around a key time, a rotation vector, and how much more of the colors it explains than
    no turn. clock: (T,) time steps, of which eight on either side are looked at."""
    window = [i for i in np.flatnonzero(np.abs(clock - clock[key]) <= 8) if len(looks[i].places)]
    lapses = clock[window] - clock[key]
    places, colors = _joined(looks[i] for i in window)
    variance = _variance(colors)
    of = np.repeat(np.arange(len(window)), [len(looks[i].places) for i in window])

    def explained(turns: Array, reach: int) -> Array:
        blocks = np.round(lapses / (2 * reach + 1)).astype(np.int64)
        within = lapses - blocks * (2 * reach + 1)
        values = []
        for turn in turns:
            R = Rotation.from_rotvec(within[:, None] * turn).as_matrix()
            turned = np.einsum("ni,nij->nj", places, R[of])
            values.append(_explained(turned, colors, variance, (blocks - blocks.min())[of]))
        return np.array(values)

    far = FASTEST // SEARCHES[0][0]
    turns = SEARCHES[0][0] * cubic_grid(np.arange(-far, far + 1.0))
    turns = np.radians(turns[np.linalg.norm(turns, axis=1) <= FASTEST])
    for step, reach, most in SEARCHES:
        values = explained(turns, reach)
        best = turns[np.argsort(-values, kind="stable")[:most]]
        around = np.radians(step / 2) * cubic_grid(np.arange(-1.0, 2.0))
        turns = np.unique((best[:, None] + around).reshape(-1, 3).round(9), axis=0)
    return best[0], float(values.max() - explained(np.zeros((1, 3)), reach)[0])


def _turns(looks: list[_Look], clock: Array) -> Array:
    """(T, 3, 3) rotations of a part, from the key time at which a turn explains most, which up to five time steps from
    there is kept. clock: (T,) time steps."""
    seen = np.flatnonzero([len(look.places) for look in looks])
    keys = np.unique(seen[evenly_indices(len(seen), 5)[1:-1]]).tolist()
    turn, _, key = max(((*_turn_at(looks, clock, key), key) for key in keys), key=lambda found: found[1])
    lapses = clock - clock[key]
    R = Rotation.from_rotvec(lapses[:, None] * turn).as_matrix()
    known = np.zeros((4, SIDE, SIDE, SIDE))
    for i in sorted(range(len(looks)), key=lambda i: (abs(i - key), i)):
        last = i - np.sign(i - key) * np.arange(1, MEMORY + 2)
        if abs(lapses[i]) > 5 and 0 <= last[-1] < len(looks):
            steps = Rotation.from_matrix(R[last[:-1]] @ np.swapaxes(R[last[1:]], 1, 2)).as_rotvec()
            turn = (steps / (clock[last[:-1]] - clock[last[1:]])[:, None]).mean(axis=0)
            onward = Rotation.from_rotvec((clock[i] - clock[last[0]]) * turn).as_matrix()
            R[i] = _turn_of(looks[i], onward @ R[last[0]], known)
        known += _known(looks[i], R[i])
    return R


def _known(look: _Look, R: Array) -> Array:
    """(4, SIDE, SIDE, SIDE) number of samples, and sums of their colors, that a time of rotation R (3, 3) shows of a
    ball's places of size FINE."""
    cells = _cells(look.places @ R, FINE)
    sums = [np.bincount(cells, values, SIDE**3) for values in (None, *look.colors.T)]
    return np.array(sums, np.float64).reshape(4, SIDE, SIDE, SIDE)


def _turn_of(look: _Look, expected: Array, sums: Array) -> Array:
    """The rotation (3, 3) near the expected one by which a time fits best what others show, as `_known` gives it."""
    if not len(look.places):
        return expected
    total, mean = sums[0].sum(), sums[1:].sum(axis=(1, 2, 3)) / sums[0].sum()
    count, *blurred = (gaussian_filter(each, BLUR, mode="constant", truncate=2.5).ravel() for each in sums)
    unknown = 1e-5 * total
    known = ((np.array(blurred) + unknown * mean[:, None]) / (count + unknown)).T
    variance = max(_variance(look.colors), 1e-6)
    best = expected
    for step, half in AROUND:
        R = Rotation.from_rotvec(np.radians(step) * cubic_grid(np.arange(-half, half + 1.0))).as_matrix() @ best
        cells = _cells(look.places @ R, FINE)
        errors = np.square(known[cells] - look.colors).sum(axis=2).mean(axis=1) / variance
        away = np.degrees(Rotation.from_matrix(R @ expected.T).magnitude())
        best = R[int((errors + (away / AS_BEFORE) ** 2).argmin())]
    return best


def _smoothed(R: Array, clock: Array, near: NDArray[np.floating]) -> Array:
    """Rotations (T, 3, 3) of which each is the mean of those around, by weights (T, T), as they go on from it."""
    steps = Rotation.from_matrix(R[1:] @ np.swapaxes(R[:-1], 1, 2)).as_rotvec() / np.diff(clock)[:, None]
    smooth = np.empty_like(R)
    for i, weights in enumerate(near):
        around = np.flatnonzero(np.abs(weights) > 1e-3)
        speed = np.median(steps[around[0] : around[-1]], axis=0)  # what is left beside it is far from half a turn
        ahead = Rotation.from_rotvec((clock[around] - clock[i])[:, None] * speed).as_matrix()
        beside = Rotation.from_matrix(np.swapaxes(ahead, 1, 2) @ R[around] @ R[i].T).as_rotvec()
        smooth[i] = Rotation.from_rotvec(weights[around] @ beside).as_matrix() @ R[i]
    return smooth
