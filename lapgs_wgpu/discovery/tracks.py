"""Tracks: surface points of all times linked to points that move.

Points of a key time, at which things are apart, form parts. Each part is followed from there to both ends of the clip
(`follower`). What no track explains forms the parts of the next key time.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from lapgs_wgpu.data.timestamps import time_step
from lapgs_wgpu.discovery.follower import LEAST_PART, Follower
from lapgs_wgpu.discovery.residual import Floats
from lapgs_wgpu.discovery.surface_points import PointClouds, Points, merged
from lapgs_wgpu.discovery.trajectories import Trajectory, find_trajectories

# In half sides of the box, 1.3 in the presets:
VOXEL = 0.045  # spacing of a track's points
REACH = 0.07  # distance within which a track explains a point
FOLLOWED = 0.5  # of all points, how close tracks come that are good enough
CLOSE = 0.03  # standard deviation of the distance from a track, by which two sets of tracks are compared
CALM = 0.02  # jitter of a part's center that is no leaping
LEAST_SEEN, LEAST_VISIT = 0.4, 0.2  # share of the times at which a part must be seen; that comes, stays and goes once
LEAPS, LEAP_SIZE = 1.7, 0.28  # jitter of a leaping center, in steps of its smoothed path, and in sizes of its part
EVEN = 0.35  # variation of the number of points that a part explains, relative to their mean, of one thing
EXPLAINED = 0.3  # weight of points that an earlier key time's tracks explain
SMOOTHING = 2.0  # times; standard deviation of the weights by which paths are smoothed
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

    @property
    def parts(self) -> int:
        """The number of parts."""
        return int(self.part.max()) + 1

    def center(self, k: int) -> Floats:
        """(T, 3) the mean of the points of part k."""
        return self.paths[:, self.part == k].mean(axis=1)

    def radius(self, k: int) -> float:
        """Of the ball around part k."""
        arms = self.paths[:, self.part == k] - self.center(k)[:, None]
        return float(np.quantile(np.linalg.norm(arms, axis=2), 0.9))

    def of_parts(self, kept: NDArray[np.bool_]) -> "Tracks | None":
        """The tracks of the parts (p,) that are set, and numbered anew; None where there are none."""
        chosen = kept[self.part]
        if not chosen.any():
            return None
        return self.rows(chosen)._replace(part=np.unique(self.part[chosen], return_inverse=True)[1])

    def rows(self, chosen: NDArray[np.bool_]) -> "Tracks":
        """The tracks (n,) that are set, with the numbers of their parts."""
        of_time = self.paths[:, chosen], self.supported[:, chosen]
        return Tracks(self.positions[chosen], self.colors[chosen], self.part[chosen], *of_time)


def all_of(tracks: Sequence[Tracks]) -> Tracks:
    """The tracks of several sets, at least one, in their order."""
    columns = list(zip(*tracks, strict=True))
    return Tracks(*map(np.concatenate, columns[:3]), *(np.concatenate(each, axis=1) for each in columns[3:]))


def find_tracks(clouds: PointClouds) -> Tracks | None:
    """Tracks of the surface points of a clip; None where nothing can be followed.

    Many parts are apart where things part, and also where one thing falls to patches. Which it is shows in how close
    to all points the tracks come that start there. Where that is far, trajectories that share groups may do better.
    """
    closest, best = 0.0, None
    for trajectories in find_trajectories(clouds):
        known: dict[tuple[int, ...], tuple[Tracks, Floats] | None] = {}
        for many in (0.5, 0.75):  # quantiles over the times
            if (tracks := _tracks_by(many, clouds, trajectories, known)) is None:
                continue
            apart = [distances / (CLOSE * clouds.half_side) for distances, _ in clouds.nearest(tracks.paths)]
            if (close := sum(float(np.exp(-0.5 * each**2).sum()) for each in apart)) > closest:
                closest, best = close, tracks
        if closest >= FOLLOWED * clouds.total:
            break
    return best


def _tracks_by(
    many: float,
    clouds: PointClouds,
    trajectories: list[Trajectory],
    known: dict[tuple[int, ...], tuple[Tracks, Floats] | None],
) -> Tracks | None:
    """The tracks from key times at which as many parts are apart as this quantile of all times has.

    known: what `_tracks_from` found by the key times up to its own; it grows.
    """
    free = [np.ones(len(cloud.scores), bool) for cloud in clouds.clouds]
    found: list[Tracks] = []
    keys: tuple[int, ...] = ()
    for _ in range(4):  # key times
        rest = [cloud.chosen(mask) for cloud, mask in zip(clouds.clouds, free, strict=True)]
        key = _key_time(rest, many, clouds)
        if sum(len(points.scores) for points in rest) < 0.05 * clouds.total or key is None:
            break
        weighted = tuple(
            points._replace(scores=points.scores * np.where(mask, 1.0, EXPLAINED).astype(np.float32))
            for points, mask in zip(clouds.clouds, free, strict=True)
        )
        keys += (key,)
        if keys not in known:
            known[keys] = _tracks_from(key, _around(rest, key), clouds._replace(clouds=weighted), trajectories)
        if (followed := known[keys]) is None:
            break
        tracks, paths = followed
        reached = [(distances < REACH * clouds.half_side, of) for distances, of in clouds.nearest(paths)]
        explained = np.stack([np.bincount(tracks.part[of[near]], minlength=tracks.parts) for near, of in reached])
        if (steady := tracks.of_parts(_steady(tracks, paths, explained, clouds.half_side))) is not None:
            found.append(steady._replace(part=steady.part + (found[-1].parts if found else 0)))
        free = [mask & ~near for mask, (near, _) in zip(free, reached, strict=True)]
    return all_of(found) if found else None


def _key_time(rest: list[Points], many: float, clouds: PointClouds) -> int | None:
    """The time of most of the points that are left among those at which many parts are apart."""
    some = [points.thinned(300) for points in rest]
    parts = np.array([(np.bincount(clouds.parts(_around(some, i))) >= LEAST_PART).sum() for i in range(len(some))])
    if not parts.any():
        return None
    usual = int(np.quantile(parts[parts > 0], many))
    mass = np.convolve([points.scores.sum() for points in rest], np.ones(5), "same")[: len(rest)]
    apart = (ndimage.minimum_filter1d(parts, 3, mode="nearest") >= usual) & (parts <= usual + 1)
    return int(np.lexsort((mass, apart))[-1])


def _around(clouds: list[Points], i: int) -> Points:
    """The points of a time and of its neighbours."""
    return merged(clouds[max(0, i - 1) : i + 2])


def _voxels(points: Points, size: float, least: int) -> Points:
    """One point for each cell with at least `least` points: their mean by score."""
    _, of, counts = np.unique(
        np.floor(points.positions / size).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    factors = (1.0, *points.positions.T, *points.colors.T)
    weights, *sums = (np.bincount(of.ravel(), points.scores * factor) for factor in factors)
    means = np.stack([*(each / weights for each in sums), weights / counts], axis=1)
    kept = means[counts >= least].astype(np.float32)
    return Points(kept[:, :3], kept[:, 3:6], kept[:, 6])


def _tracks_from(
    key: int, start: Points, clouds: PointClouds, trajectories: list[Trajectory]
) -> tuple[Tracks, Floats] | None:
    """The points of a key time, followed twice: first those of that time, then with all that belongs to them; and their
    paths before these were smoothed, which are nearer to the points of each time."""
    found = None
    for most, least in (150, 1), (300, 3):  # points in all; surface points of each voxel
        if found is not None:
            start = _at_key_time(key, found[0].paths, clouds)
        follower = Follower(_voxels(start, VOXEL * clouds.half_side, least).thinned(most), key, clouds, trajectories)
        if len(follower.part) == 0:
            break
        paths = follower.follow()
        distances = [cKDTree(cloud.positions).query(at)[0] for cloud, at in zip(clouds.clouds, paths, strict=True)]
        near = np.array(distances) < REACH * clouds.half_side
        supported, smooth = np.empty_like(near), np.empty_like(paths)
        for k in range(follower.part.max() + 1):
            members = follower.part == k
            seen = near[:, members].mean(axis=1) > SUPPORTED
            supported[:, members] = seen[:, None]
            # The image of a time shows one side of a part, and pulls it towards that side.
            fitted = parabolas(clouds.times, np.where(seen, 1.0, 0.1), SMOOTHING)
            smooth[:, members] = np.tensordot(fitted, paths[:, members], axes=1)
        found = Tracks(follower.positions, follower.colors, follower.part, smooth, supported), paths
    return found


def _at_key_time(key: int, paths: Floats, clouds: PointClouds) -> Points:
    """All points of the clip that tracks (T, n, 3) explain, moved with them to the key time."""
    moved = []
    for points, path, (distances, of) in zip(clouds.clouds, paths, clouds.nearest(paths), strict=True):
        near = distances < REACH * clouds.half_side
        positions = points.positions[near] + (paths[key] - path)[of[near]]
        moved.append(points.chosen(near)._replace(positions=positions))
    return merged(moved)


def _steady(tracks: Tracks, paths: Floats, explained: NDArray[np.int64], half_side: float) -> NDArray[np.bool_]:
    """(p,) bool: parts that are visible long enough and do not jump between objects.

    Patches that the static fit only blurs come and go, and a part that follows them leaps from one to the next. A part
    is one object if it stands still, moves more than it jitters, or explains as many points at one time as at another.
    paths: (T, n, 3), before they were smoothed. explained: (T, p) how many points of a time each part explains.
    """
    steady = np.zeros(tracks.parts, bool)
    for k in range(len(steady)):
        members, center = tracks.part == k, tracks.center(k)
        seen = tracks.supported[:, members][:, 0]
        visits = np.count_nonzero(np.diff(seen, prepend=False) & seen)
        if seen.mean() < (LEAST_VISIT if visits == 1 else LEAST_SEEN):
            continue
        jitter = np.linalg.norm(paths[:, members].mean(axis=1) - center, axis=1)[seen].mean()
        steps = np.linalg.norm(np.diff(center, axis=0), axis=1)[seen[1:] & seen[:-1]]
        step = np.median(steps) if len(steps) else 0.0
        size = np.ptp(tracks.positions[members], axis=0).max()
        still = np.ptp(center[seen], axis=0).max() < 0.5 * size
        even = explained[seen, k].std() < EVEN * explained[seen, k].mean()
        leaps = LEAP_SIZE * size if even else min(LEAPS * step, LEAP_SIZE * size)
        steady[k] = still or jitter < max(leaps, CALM * half_side)
    return steady


def parabolas(times: NDArray[np.float64], weights: NDArray[np.float64] | float, spread: float) -> NDArray[np.floating]:
    """(T, T) what turns values at the times (T,) into those of the parabolas fitted around each, by weights (T,) of
    the values and by a Gaussian of this standard deviation, time steps."""
    clock = times / time_step(times)
    lapses = (clock - clock[:, None]) / spread
    basis = np.stack([np.ones_like(lapses), lapses, lapses**2], axis=2)
    weighted = np.swapaxes(basis, 1, 2) * (np.exp(-0.5 * lapses**2) * weights)[:, None]
    ridge = np.diag([0.0, 1e-2, 1e-2])  # of slope and curvature, which few times do not determine
    return np.linalg.solve(weighted @ basis + ridge, weighted)[:, 0]
