"""Trajectories: where groups of surface points go over the whole clip, as far as their centers tell.

Dynamic programming links the groups of points of all times to the path that explains most of them and bends least;
its groups are then worth less, and the next path is looked for. A path may leap over times at which nothing is seen,
and may turn sharply a few times. `tracks` takes it as a second opinion where things are fast, hidden, or turn sharply.

Such paths share groups, and change over where things meet. So as many paths as there usually are groups are given the
groups of each time at once, one to one; those that meet, and all across a gap between the images, bend least.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.optimize import linear_sum_assignment

from lapgs_wgpu.data.timestamps import time_step
from lapgs_wgpu.discovery.residual import Floats
from lapgs_wgpu.discovery.surface_points import PointClouds

LEAST_GROUP, FULL_GROUP = 6, 20  # points of a group, and from which on it counts in full
LEAP = 6  # time steps from one group of a path to the next, at most
SKIPPED = 0.1  # cost of a time that a path leaps over; a group on it is worth 1
AGAIN = 0.1  # worth of a group that is on an earlier path
LEAST_WORTH = 8.0  # of a path
COLOR_SPREAD = 0.15
SHARP = 2.0  # highest cost of a bend, and of a change of color
WINDOW = 1.0  # time steps; standard deviation of the weights by which a path is smoothed
# In half sides of the box:
BEND = 0.3  # standard deviation of a group's center around the straight continuation of its path
STEP = 0.7  # from one time to the next, at most
REACHES = 0.5, 0.25, 0.12  # within twice this a path may be given a group, in rounds
MEETING = 0.6  # paths that meet come so near
MEET_TIMES, MEET_GAP = 10, 2  # times before and after a meeting that tell who is who; those around it that do not
STRAYS = 0.05  # distance of a group from its path, beyond which it says less there


class Trajectory(NamedTuple):
    """centers: (T, 3) world units, interpolated where nothing is seen. seen: (T,) bool."""

    centers: Floats
    seen: NDArray[np.bool_]


class _Groups(NamedTuple):
    """The groups of all times. clock: (T,) these, in typical time steps. half_side: of the box. time: (n,) the index of
    each group's. centers, colors: (n, 3). worth: (n,) in [0, 1]."""

    clock: NDArray[np.float64]
    half_side: float
    time: NDArray[np.int64]
    centers: NDArray[np.float64]
    colors: NDArray[np.float64]
    worth: NDArray[np.float64]


def find_trajectories(clouds: PointClouds) -> list[list[Trajectory]]:
    """Trajectories of what the surface points show, those that explain most first: one to one, and then as they were
    found, where that differs."""
    groups = _groups(clouds)
    paths: list[list[int]] = []
    while len(paths) < 8:
        path, worth = _best_path(groups)
        if worth < LEAST_WORTH:
            break
        groups.worth[path] *= AGAIN
        paths.append(path)
    at_once = int(np.quantile(np.bincount(groups.time, minlength=len(groups.clock)), 0.75))
    given = _one_to_one(groups, paths[:at_once]) + paths[at_once:]

    def trajectory(path: list[int]) -> Trajectory:
        seen = np.isin(np.arange(len(groups.clock)), groups.time[path])
        return Trajectory(_smooth(groups, path, bent=True), seen)

    return [[trajectory(path) for path in each] for each in ([given] if given == paths else [given, paths])]


def _groups(clouds: PointClouds) -> _Groups:
    rows = []
    for i, points in enumerate(clouds.clouds):
        part = clouds.parts(points)
        for k in np.flatnonzero(np.bincount(part, minlength=1) >= LEAST_GROUP):
            positions, colors, scores = points.chosen(part == k)
            rows.append([i, *positions.mean(axis=0), *colors.mean(axis=0), min(1.0, len(scores) / FULL_GROUP)])
    table = np.array(rows, np.float64).reshape(-1, 8)
    of_groups = table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4:7], table[:, 7].copy()
    return _Groups(clouds.times / time_step(clouds.times), clouds.half_side, *of_groups)


def _best_path(groups: _Groups) -> tuple[list[int], float]:
    """The groups on the path of the highest worth, in the order of time, and that worth.

    A state is a step from one group to another; what it is worth depends on the steps that end where it starts.
    """
    clock, half_side = groups.clock[groups.time], groups.half_side
    first = np.searchsorted(groups.time, np.arange(len(groups.clock)))
    # Of the steps that end in each group: the groups that they start from, their velocities and worths, and which step
    # of their start they go on from (-1: none).
    steps: list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]] = []
    for b, (time, center, color) in enumerate(zip(groups.time, groups.centers, groups.colors, strict=True)):
        a = np.arange(first[max(0, time - LEAP)], first[time])
        velocity = (center - groups.centers[a]) / (clock[b] - clock[a])[:, None]
        near = np.abs(velocity).max(axis=1, initial=0.0) <= STEP * half_side
        a, velocity = a[near], velocity[near]
        change = ((color - groups.colors[a]) ** 2).sum(axis=1) / (2 * COLOR_SPREAD**2)
        gain = groups.worth[b] - SKIPPED * (time - groups.time[a] - 1) - np.minimum(SHARP, change)
        worth, origin = groups.worth[a], np.full(len(a), -1)
        for i, group in enumerate(a):
            _, velocities, worths, _ = steps[group]
            bend = ((velocity[i] - velocities) ** 2).sum(axis=1) / (2 * (BEND * half_side) ** 2)
            totals = worths - np.minimum(SHARP, bend)
            if totals.max(initial=-np.inf) > worth[i]:
                worth[i], origin[i] = totals.max(), totals.argmax()
        steps.append((a, velocity, worth + gain, origin))
    totals = np.array([worths.max(initial=0.0) for _, _, worths, _ in steps])
    if not totals.any():
        return [], 0.0
    group = int(totals.argmax())
    step, path = int(steps[group][2].argmax()), [group]
    while step >= 0:
        starts, _, _, before = steps[group]
        group, step = int(starts[step]), int(before[step])
        path.append(group)
    return path[::-1], float(totals.max())


def _one_to_one(groups: _Groups, paths: list[list[int]]) -> list[list[int]]:
    """The paths, to which the groups of each time are given all at once, each to one (the Hungarian method)."""
    if len(paths) < 2:
        return paths
    for reach in REACHES:
        _uncross(groups, paths)
        centers = np.stack([_smooth(groups, path, alone=True) for path in paths])
        colors = np.stack([np.median(groups.colors[path], axis=0) for path in paths])
        given: list[list[int]] = [[] for _ in paths]
        for i in range(len(groups.clock)):
            here = np.flatnonzero(groups.time == i)
            away = np.linalg.norm(centers[:, i, None] - groups.centers[here], axis=2) / (reach * groups.half_side)
            change = ((colors[:, None] - groups.colors[here]) ** 2).sum(axis=2) / (2 * COLOR_SPREAD**2)
            cost = away**2 + 0.5 * np.minimum(SHARP, change)
            for row, column in zip(*linear_sum_assignment(np.minimum(cost, 4.0)), strict=True):
                if away[row, column] < 2:
                    given[row].append(int(here[column]))
        paths = [own if len(own) >= LEAST_WORTH else path for own, path in zip(given, paths, strict=True)]
    return paths


def _uncross(groups: _Groups, paths: list[list[int]]) -> None:
    """Exchange the ends of two paths behind a meeting or a gap, where both then bend less and keep their colors."""
    gaps = np.diff(groups.clock) > MEET_GAP
    for a, b in combinations(range(len(paths)), 2):
        apart = np.linalg.norm(_smooth(groups, paths[a]) - _smooth(groups, paths[b]), axis=1)
        least = minimum_filter1d(apart, 2 * MEET_TIMES + 1, mode="nearest")
        meet = (apart < MEETING * groups.half_side) & (apart == least)
        for i in (1 + np.flatnonzero(meet[1:-1] | gaps[1:])).tolist():
            before = [[g for g in paths[n] if groups.time[g] <= i] for n in (a, b)]
            after = [[g for g in paths[n] if groups.time[g] > i] for n in (a, b)]
            both = list(zip(before, after, strict=True)), list(zip(before, after[::-1], strict=True))
            bends = [sum(_bend(groups, i, *path) for path in each) for each in both]
            changes = [sum(_change(groups, *path) for path in each) for each in both]
            better = bends[1] < bends[0] and changes[1] < changes[0] + COLOR_SPREAD
            crossed = [one + other for one, other in both[1]]
            if better and min(len(path) for path in crossed) >= LEAST_WORTH:
                paths[a], paths[b] = crossed


def _bend(groups: _Groups, at: int, before: list[int], after: list[int]) -> float:
    """How far groups of a path shortly before and after a time are from a parabola: Cauchy's loss, since some stray."""
    around = [g for g in before + after if MEET_GAP < abs(groups.time[g] - at) <= MEET_GAP + MEET_TIMES]
    if len(around) < 6:
        return 0.0
    basis = np.vander((groups.clock[groups.time[around]] - groups.clock[at]) / MEET_TIMES, 3)
    centers, weights = groups.centers[around], np.ones((len(around), 1))
    for _ in range(8):
        parabola = np.linalg.lstsq(weights * basis, weights * centers, rcond=None)[0]
        away = np.linalg.norm(centers - basis @ parabola, axis=1) / (STRAYS * groups.half_side)
        weights = 1 / np.sqrt(1 + away[:, None] ** 2)
    return float(np.log1p(away**2).sum())


def _change(groups: _Groups, before: list[int], after: list[int]) -> float:
    """Distance of the colors of a path before and after a moment."""
    if not (before and after):
        return 0.0
    return float(np.linalg.norm(np.median(groups.colors[before], axis=0) - np.median(groups.colors[after], axis=0)))


def _smooth(groups: _Groups, path: list[int], *, alone: bool = False, bent: bool = False) -> Floats:
    """(T, 3) the path at every time: a straight line fitted to the groups around it, by weights that fall off in time.
    alone: without those of the time itself. bent: a parabola across times without groups, where what circles turns."""
    centers = groups.centers[path]
    lapses = groups.clock[groups.time[path]] - groups.clock[:, None]
    counted = (lapses != 0) | (not alone)
    nearest = np.where(counted, np.abs(lapses), np.inf).min(axis=1)[:, None]
    leapt = bent & (nearest > 0) & (lapses[:, :1] < 0) & (lapses[:, -1:] > 0)
    weights = counted * np.exp(-0.5 * (lapses / (WINDOW + np.where(leapt, 0.5, 1.0) * nearest)) ** 2)
    result = np.zeros((len(lapses), 3), np.float32)
    for i, (weight, lapse) in enumerate(zip(weights, lapses, strict=True)):
        ridge = [0.0, 1e-3, 1e-2] if leapt[i, 0] else [0.0, 1e-3 + nearest[i, 0]]  # its ends hardly go on
        basis = np.vander(lapse, len(ridge), increasing=True)
        product = basis.T * weight
        result[i] = np.linalg.solve(product @ basis + np.diag(ridge), product @ centers)[0]
    return result
