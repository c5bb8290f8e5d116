"""Tracks: surface points of all times linked to points that move.

Points of a key time, at which things are apart, form parts. Each part is followed from there to both ends of the clip.
Its motion so far predicts a translation, and so does the trajectory of its center (`trajectories`); a search around
both finds the translation that explains most points; and a registration in the manner of coherent point drift
(Myronenko and Song 2010), stiff within a part, bends it. What no track explains forms the parts of the next key time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .residual import Floats
from .surface_points import PointClouds, Points, parts_of
from .trajectories import Trajectory, find_trajectories, time_step

KEY_TIMES = 4  # from which is tracked, at most
LEAST_REST = 0.05  # share of the points without a track that is worth another key time
LEAST_PART = 12  # points
ROUGH, FINE = 150, 300  # points of a key time: when first followed, and with the points of all times brought there
PROBES = 300  # points of a time by which parts are counted, at most
DATA = 160  # points of a time that a part is compared with, at most
MEMORY = 6  # times from which a motion is predicted
ROUNDS = 5  # of the registration
# In half sides of the box, 1.3 in the presets:
LINK = 0.11  # points closer than this are of one part
VOXEL = 0.045  # spacing of a track's points
REACH = 0.07  # distance within which a track explains a point
UNIT = 0.077  # half the size of a small object: the search goes by this
# In UNIT:
SEARCH = 2.4  # radius around the predicted place
SEARCH_STEPS = 1.2, 0.6  # of a rough search, and of a fine one around its best places
SEARCH_SPREADS = 0.9, 0.5  # standard deviation of the distance from a part at which it explains a point
FAST = 2.5  # the search reaches as far as this many times the way from one time to the next
PRIOR = 2.0  # standard deviation of the true place around it
STIFF, SOFT = 5.0, 2.0  # standard deviation of the kernel over which a part moves together, first and last
WIDE, NARROW = 0.6, 0.35  # standard deviation of the registration, first and last
CANDIDATES = 4  # best places of the rough search
COLOR_SPREAD = 0.3
NOISE = 0.1  # weight of the hypothesis that a point belongs to no track
EXPLAINED = 0.3  # weight of points that an earlier key time's tracks explain
LOST = 0.3  # a part is lost where it explains less than this share of what it usually does
SMOOTHING = 2.0  # times; standard deviation of the weights by which paths are smoothed
RIDGE = 1e-2  # of slope and curvature, which few times do not determine
UNSUPPORTED = 0.1  # weight of a time at which a part is not seen
SUPPORTED = 0.3  # share of a part's points with surface points within REACH, from which on it is seen


class Tracks(NamedTuple):
    """n moving points over T times.

    positions: (n, 3) at their key time, world units. colors: (n, 3). part: (n,) int. paths: (T, n, 3) world units.
    supported: (T, n) bool, whether surface points of that time agree.
    """

    positions: Floats
    colors: Floats
    part: NDArray[np.int64]
    paths: Floats
    supported: NDArray[np.bool_]


class Found(NamedTuple):
    """tracks: None where nothing can be followed. explained: share of the surface points within reach of a track."""

    tracks: Tracks | None
    explained: float


def find_tracks(clouds: PointClouds, half_side: float) -> Found:
    """Tracks of the surface points of a clip. half_side: of the box that they lie in, world units."""
    free = [np.ones(len(cloud.scores), bool) for cloud in clouds.clouds]
    trajectories = find_trajectories(clouds, LINK * half_side, half_side)
    found: list[Tracks] = []
    for _ in range(KEY_TIMES):
        rest = [Points(*(values[mask] for values in cloud)) for cloud, mask in zip(clouds.clouds, free, strict=True)]
        key = _key_time(rest, half_side)
        if sum(len(points.scores) for points in rest) < LEAST_REST * clouds.total or key is None:
            break
        weighted = [
            points._replace(scores=points.scores * np.where(mask, 1.0, EXPLAINED).astype(np.float32))
            for points, mask in zip(clouds.clouds, free, strict=True)
        ]
        followed = _tracks_from(key, _merged(rest, key), clouds.times, weighted, trajectories, half_side)
        if followed is None:
            break
        found.append(followed[0])
        for mask, points, path in zip(free, clouds.clouds, followed[1], strict=True):
            if len(points.scores):
                mask &= cKDTree(path).query(points.positions)[0] >= REACH * half_side
    if not found:
        return Found(None, 0.0)
    offsets = np.cumsum([0, *(tracks.part.max() + 1 for tracks in found[:-1])])
    tracks = Tracks(
        np.concatenate([each.positions for each in found]),
        np.concatenate([each.colors for each in found]),
        np.concatenate([each.part + offset for each, offset in zip(found, offsets, strict=True)]),
        np.concatenate([each.paths for each in found], axis=1),
        np.concatenate([each.supported for each in found], axis=1),
    )
    return Found(tracks, 1.0 - sum(int(mask.sum()) for mask in free) / clouds.total)


def _key_time(clouds: list[Points], half_side: float) -> int | None:
    """The time of most points among those at which no fewer parts than usual are apart."""
    some = [_thinned(points, PROBES) for points in clouds]
    parts = np.array([_count_parts(_merged(some, i), half_side) for i in range(len(clouds))])
    if not parts.any():
        return None
    usual = int(np.median(parts[parts > 0]))
    mass = np.convolve([points.scores.sum() for points in clouds], np.ones(5), "same")[: len(clouds)]
    least = np.minimum(parts, np.minimum(np.append(parts[1:], parts[-1]), np.append(parts[0], parts[:-1])))
    apart = (least >= usual) & (parts <= usual + 1)
    return int(np.lexsort((mass, apart))[-1])


def _merged(clouds: list[Points], i: int) -> Points:
    """The points of a time and of its neighbours."""
    near = clouds[max(0, i - 1) : i + 2]
    return Points(*(np.concatenate(values) for values in zip(*near, strict=True)))


def _count_parts(points: Points, half_side: float) -> int:
    if len(points.scores) < LEAST_PART:
        return 0
    return int((np.bincount(parts_of(points.positions, LINK * half_side)) >= LEAST_PART).sum())


def _voxels(points: Points, size: float, least: int) -> Points:
    """One point for each cell with at least `least` points: their mean by score."""
    cells, of, counts = np.unique(
        np.floor(points.positions / size).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    of = of.ravel()
    weights = np.bincount(of, points.scores, minlength=len(cells))

    def mean(values: Floats) -> Floats:
        sums = [np.bincount(of, points.scores * values[:, k], minlength=len(cells)) for k in range(3)]
        return (np.stack(sums, axis=1) / weights[:, None]).astype(np.float32)

    kept = counts >= least
    return Points(mean(points.positions)[kept], mean(points.colors)[kept], (weights / counts)[kept].astype(np.float32))


def _thinned(points: Points, most: int) -> Points:
    chosen = np.linspace(0, len(points.scores) - 1, min(most, len(points.scores))).astype(np.int64)
    return Points(*(values[chosen] for values in points))


def _tracks_from(
    key: int,
    start: Points,
    times: NDArray[np.float64],
    clouds: list[Points],
    trajectories: list[Trajectory],
    half_side: float,
) -> tuple[Tracks, Floats] | None:
    """The points of a key time, followed twice: first those of that time, then with all that belongs to them.

    Returns the tracks, and their paths before these were smoothed, which are nearer to the points of each time.
    """
    template = _thinned(_voxels(start, VOXEL * half_side, least=1), ROUGH)
    found = None
    for last in (False, True):
        follower = _Follower(template, half_side)
        if len(follower.positions) == 0:
            break
        paths = follower.follow(key, times, clouds, trajectories)
        supported = _supported(paths, follower.part, clouds, half_side)
        smooth = _smoothed(times, paths, supported, follower.part)
        found = Tracks(follower.positions, follower.colors, follower.part, smooth, supported), paths
        if not last:
            template = _thinned(_at_key_time(key, smooth, clouds, half_side), FINE)
    return found


def _supported(paths: Floats, part: NDArray[np.int64], clouds: list[Points], half_side: float) -> NDArray[np.bool_]:
    """(T, n) whether the surface points of a time agree with a point's part."""
    supported = np.zeros(paths.shape[:2], bool)
    for i, points in enumerate(clouds):
        if len(points.scores):
            near = cKDTree(points.positions).query(paths[i])[0] < REACH * half_side
            supported[i] = (np.bincount(part, near) / np.bincount(part))[part] > SUPPORTED
    return supported


def _smoothed(
    times: NDArray[np.float64], paths: Floats, supported: NDArray[np.bool_], part: NDArray[np.int64]
) -> Floats:
    """Paths (T, n, 3), each a parabola fitted to the times around: the image of a time shows one side of a part, and
    pulls it towards that side."""
    clock = times / time_step(times)
    apart = clock[:, None] - clock
    falloff = np.exp(-0.5 * (apart / SMOOTHING) ** 2)
    basis = np.stack([np.ones_like(apart), -apart / SMOOTHING, (apart / SMOOTHING) ** 2], axis=2)
    ridge = np.diag([0.0, RIDGE, RIDGE])
    smooth = np.empty_like(paths)
    for k in range(int(part.max()) + 1):
        members = part == k
        weights = falloff * np.where(supported[:, members][:, 0], 1.0, UNSUPPORTED)
        weighted = np.swapaxes(basis, 1, 2) * weights[:, None]
        fit = np.linalg.solve(
            weighted @ basis + ridge, weighted
        )  # (T, 3, T): coefficients of the parabola at each time
        smooth[:, members] = np.tensordot(fit[:, 0], paths[:, members], axes=1)
    return smooth


def _at_key_time(key: int, paths: Floats, clouds: list[Points], half_side: float) -> Points:
    """All points of the clip that a track (paths: (T, n, 3)) explains, moved with it to the key time."""
    parts = []
    for points, path in zip(clouds, paths, strict=True):
        if len(points.scores):
            distances, of = cKDTree(path).query(points.positions)
            near = distances < REACH * half_side
            moved = points.positions[near] + (paths[key] - path)[of[near]]
            parts.append(Points(moved, points.colors[near], points.scores[near]))
    merged = Points(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    return _voxels(merged, VOXEL * half_side, least=3)


class _Follower:
    """Follows the parts of a key time's points."""

    def __init__(self, template: Points, half_side: float) -> None:
        unit = UNIT * half_side
        part = parts_of(template.positions, LINK * half_side)
        kept = np.bincount(part)[part] >= LEAST_PART
        self.positions, self.colors = template.positions[kept], template.colors[kept]
        self.part = np.unique(part[kept], return_inverse=True)[1].ravel()
        sizes = np.bincount(self.part) if len(self.part) else np.zeros(0, np.int64)
        # Large parts choose first: what they explain is less attractive to the small ones.
        self._members = [np.flatnonzero(self.part == k) for k in np.argsort(-sizes, kind="stable")]
        self._unit, self._half_side = unit, half_side
        same = self.part[:, None] == self.part[None]
        apart = ((self.positions[:, None] - self.positions[None]) ** 2).sum(axis=2)
        self._kernels = [np.exp(-apart / (2 * (h * unit) ** 2)).astype(np.float32) * same for h in (STIFF, SOFT)]
        rough = unit * _grid(SEARCH, SEARCH_STEPS[0])
        self._rough = rough[np.linalg.norm(rough, axis=1) < (SEARCH + 1e-3) * unit]
        self._fine = unit * _grid(SEARCH_STEPS[1], SEARCH_STEPS[1])
        self._usual: list[list[float]] = [[] for _ in self._members]
        self._lost = [0] * len(self._members)
        self._speed = [0.0] * len(self._members)  # world units from one time to the next

    def follow(
        self, key: int, times: NDArray[np.float64], clouds: list[Points], trajectories: list[Trajectory]
    ) -> Floats:
        """(T, n, 3) paths over all times."""
        expected = [self._expected(members, key, trajectories) for members in self._members]
        paths = np.zeros((len(times), *self.positions.shape), np.float32)
        paths[key] = self.positions
        order = sorted((i for i in range(len(times)) if i != key), key=lambda i: (abs(i - key), i))
        past: dict[int, list[int]] = {1: [key], -1: [key]}  # times in the order in which a side was followed
        for i in order:
            side = 1 if i > key else -1
            known = past[side] if len(past[side]) >= MEMORY else past[-side][1:MEMORY][::-1] + past[side]
            start = self._predict(times[known[-MEMORY:]], paths[known[-MEMORY:]], times[i])
            centers = [None if path is None else path[i] for path in expected]
            paths[i] = self._register(start, clouds[i], centers, first=len(past[side]) == 1)
            past[side].append(i)
        return paths

    def _expected(self, members: NDArray[np.int64], key: int, trajectories: list[Trajectory]) -> Floats | None:
        """(T, 3) centers of a part by the trajectory that passes it at the key time; None where none does."""
        center = self.positions[members].mean(axis=0)
        radius = float(np.linalg.norm(self.positions[members] - center, axis=1).max())
        for trajectory in trajectories:
            offset = center - trajectory.centers[key]
            if trajectory.seen[max(0, key - 1) : key + 2].any() and np.linalg.norm(offset) < max(radius, self._unit):
                return trajectory.centers + offset
        return None

    def _predict(self, times: NDArray[np.float64], paths: Floats, t: float) -> Floats:
        """Positions (n, 3) at time t, from those at earlier times: each part goes on by its mean's path."""
        positions = paths[-1].copy()
        if len(times) < 2:
            return positions
        span = max(float(np.abs(times - times[-1]).max()), 1e-9)
        degree = 1 if len(times) < 4 else 2
        powers = np.arange(degree + 1)
        basis, at = ((times - times[-1]) / span)[:, None] ** powers, ((t - times[-1]) / span) ** powers
        for k, members in enumerate(self._members):
            centers = paths[:, members].mean(axis=1)
            self._speed[k] = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).mean())
            if np.abs(centers[-1]).max() > self._half_side:  # it has left the box
                continue
            step = at @ np.linalg.lstsq(basis, centers, rcond=None)[0] - centers[-1]
            longest = 1.5 * float(np.linalg.norm(np.diff(centers, axis=0), axis=1).max())
            positions[members] += step * min(1.0, longest / max(float(np.linalg.norm(step)), 1e-9))
        return positions

    def _register(self, start: Floats, points: Points, expected: list[Floats | None], *, first: bool) -> Floats:
        """Positions (n, 3) of the tracks' points among the points of a time, from a prediction and from where the
        parts' centers are expected."""
        points = _thinned(points, DATA)
        positions = start.copy()
        if len(points.scores) == 0:
            return positions
        free = np.ones(len(points.scores), np.float32)
        for k, members in enumerate(self._members):
            free *= 1.0 - 0.9 * self._search(k, members, positions, points, free, expected[k], first=first)
        data, weights = points.positions, points.scores[:, None]
        alike = 0.2 + 0.8 * np.exp(-_squared(points.colors, self.colors) / (2 * COLOR_SPREAD**2))
        for step in range(ROUNDS):
            share = step / (ROUNDS - 1)
            spread = self._unit * WIDE ** (1 - share) * NARROW**share
            belongs = alike * np.exp(-_squared(data, positions) / (2 * spread**2))
            belongs *= weights / (belongs.sum(axis=1, keepdims=True) + NOISE)
            mass = belongs.sum(axis=0)[:, None]
            kernel = self._kernels[0] if share < 0.6 else self._kernels[1]
            positions = positions + (kernel @ (belongs.T @ data - mass * positions)) / (kernel @ mass + 1e-2)
        return positions

    def _search(
        self,
        k: int,
        members: NDArray[np.int64],
        positions: Floats,
        points: Points,
        free: Floats,
        expected: Floats | None,
        *,
        first: bool,
    ) -> Floats:
        """Shift a part in `positions` to where it explains most, around where it is and around where its center is
        expected; (m,) how well it explains each point there."""
        widening = min(max(1.0, FAST * self._speed[k] / (SEARCH * self._unit)), 2.0)
        reach = 1.5 if first else widening + 0.25 * min(self._lost[k], 4)
        starts = [np.zeros(3, np.float32)]
        if expected is not None:
            starts.append(expected - positions[members].mean(axis=0))
        reaches, spreads = np.array([reach, 1.0], np.float32), np.array([widening, 1.0]) * PRIOR * self._unit

        def prior(shifts: Floats) -> NDArray[np.float64]:
            apart = [((shifts - start) ** 2).sum(axis=1) for start in starts]
            return np.max([np.exp(-a / (2 * spread**2)) for a, spread in zip(apart, spreads, strict=False)], axis=0)

        shifts = np.concatenate([start + scale * self._rough for start, scale in zip(starts, reaches, strict=False)])
        rough, _ = self._explained(members, positions, points, free, shifts, SEARCH_SPREADS[0])
        chosen = np.argsort(-rough * prior(shifts), kind="stable")[:CANDIDATES]
        scale = reaches[chosen // len(self._rough)][:, None, None]
        shifts = (shifts[chosen][:, None] + scale * self._fine).reshape(-1, 3)
        scores, near = self._explained(members, positions, points, free, shifts, SEARCH_SPREADS[1])
        best = int((scores * prior(shifts)).argmax())
        if self._usual[k] and scores[best] < LOST * np.median(self._usual[k]):
            self._lost[k] += 1
            if expected is not None:
                positions[members] += expected - positions[members].mean(axis=0)
            return np.zeros(len(free), np.float32)
        self._usual[k].append(float(scores[best]))
        self._lost[k] = 0
        positions[members] += shifts[best]
        return near[best]

    def _explained(
        self,
        members: NDArray[np.int64],
        positions: Floats,
        points: Points,
        free: Floats,
        shifts: Floats,
        spread: float,
    ) -> tuple[Floats, Floats]:
        """(s,) how much of the points a part explains when it is moved by each of the shifts (s, 3), and (s, m) how
        near it then is to each of the points."""
        some = members[np.linspace(0, len(members) - 1, min(24, len(members))).astype(np.int64)]
        squared = _squared((points.positions[None] - shifts[:, None]).reshape(-1, 3), positions[some])
        nearest = squared.argmin(axis=1)
        near = np.exp(-squared[np.arange(len(squared)), nearest] / (2 * (spread * self._unit) ** 2))
        near = near.reshape(len(shifts), -1).astype(np.float32)
        apart = ((points.colors[None] - self.colors[some][nearest].reshape(len(shifts), -1, 3)) ** 2).sum(axis=2)
        alike = 0.3 + 0.7 * np.exp(-apart / (2 * 0.35**2))
        return (near * alike * free * points.scores).sum(axis=1), near


def _grid(half: float, step: float) -> Floats:
    """(n, 3) places of a cubic grid of this spacing, up to `half` from 0 along each axis."""
    axis = np.arange(-half, half + 1e-6, step, dtype=np.float32)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def _squared(a: Floats, b: Floats) -> Floats:
    """(n, m) squared distances of rows (n, d) and (m, d)."""
    product: Floats = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * (a @ b.T)
    return np.maximum(product, 0.0)
