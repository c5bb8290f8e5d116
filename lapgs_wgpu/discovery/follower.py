"""The follower: moves the parts of a key time's points along with the surface points of the other times.

The motion of a part so far predicts a translation, and so does the trajectory of its center (`trajectories`). A search
around both finds the translation that explains most points; and a registration in the manner of coherent point drift
(Myronenko and Song 2010), stiff within a part, bends it.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.evenly import evenly_indices
from lapgs_wgpu.discovery.residual import Floats, cubic_grid
from lapgs_wgpu.discovery.surface_points import PointClouds, Points
from lapgs_wgpu.discovery.trajectories import Trajectory

LEAST_PART = 12  # points
MEMORY = 6  # times from which a motion is predicted
NOISE = 0.1  # weight of the hypothesis that a point belongs to no track
LOST = 0.3  # a part is lost where it explains less than this share of what it usually does
UNIT = 0.077  # half sides of the box; half the size of a small object: the search goes by this
# In UNIT:
SEARCH = 2.4  # radius around the predicted place
ROUGH = cubic_grid(np.arange(-SEARCH, SEARCH + 1e-6, 1.2, dtype=np.float32))  # shifts of a rough search
ROUGH = ROUGH[np.linalg.norm(ROUGH, axis=1) < SEARCH + 1e-3]
FINE = cubic_grid(np.arange(-0.6, 0.6 + 1e-6, 0.6, dtype=np.float32))  # and of a fine one around its best places
FAST = 2.5  # the search reaches as far as this many times the way from one time to the next
PRIOR = 2.0  # standard deviation of the true place around it
STIFF, SOFT = 5.0, 2.0  # standard deviation of the kernel over which a part moves together, first and last
WIDE, NARROW = 0.6, 0.35  # standard deviation of the registration, first and last


@dataclass
class _Part:
    """members: (n,) rows of its points. expected: (T, 3) centers by a trajectory; None without one. usual: how much it
    explained at the times so far. lost: how many times ago it was found. speed: world units from a time to the next."""

    members: NDArray[np.int64]
    expected: Floats | None
    usual: list[float] = field(default_factory=list)
    lost: int = 0
    speed: float = 0.0


class Follower:
    """Follows the parts of a key time's points, to which positions (n, 3), colors (n, 3) and part (n,) belong."""

    def __init__(self, template: Points, key: int, clouds: PointClouds, trajectories: list[Trajectory]) -> None:
        self._key, self._clouds, self._unit = key, clouds, UNIT * clouds.half_side
        part = clouds.parts(template)
        kept = np.bincount(part)[part] >= LEAST_PART
        self.positions, self.colors, _ = template.chosen(kept)
        self.part = np.unique(part[kept], return_inverse=True)[1]
        # Large parts choose first: what they explain is less attractive to the small ones.
        members = [np.flatnonzero(self.part == k) for k in np.argsort(-np.bincount(self.part), kind="stable")]
        self._parts = [_Part(each, self._expected(each, trajectories)) for each in members]
        same = self.part[:, None] == self.part[None]
        sq_distances = ((self.positions[:, None] - self.positions[None]) ** 2).sum(axis=2)
        self._stiff, self._soft = (
            np.exp(-sq_distances / (2 * (h * self._unit) ** 2)).astype(np.float32) * same for h in (STIFF, SOFT)
        )

    def _expected(self, members: NDArray[np.int64], trajectories: list[Trajectory]) -> Floats | None:
        """(T, 3) centers of a part by the trajectory that passes it at the key time; None where none does."""
        center = self.positions[members].mean(axis=0)
        radius = float(np.linalg.norm(self.positions[members] - center, axis=1).max())
        for centers, seen in trajectories:
            offset = center - centers[self._key]
            if seen[max(0, self._key - 1) : self._key + 2].any() and np.linalg.norm(offset) < max(radius, self._unit):
                return centers + offset
        return None

    def follow(self) -> Floats:
        """(T, n, 3) paths over all times."""
        key, times = self._key, self._clouds.times
        paths = np.zeros((len(times), *self.positions.shape), np.float32)
        paths[key] = self.positions
        order = sorted(range(len(times)), key=lambda i: (abs(i - key), i))
        for n, i in enumerate(order[1:], start=1):
            known = sorted(order[:n], key=lambda j: -abs(j - i))[-MEMORY:]  # all lie on one side of it
            paths[i] = self._register(self._predict(times[known], paths[known], times[i]), i)
        return paths

    def _predict(self, times: NDArray[np.float64], paths: Floats, t: float) -> Floats:
        """Positions (n, 3) at time t, from those at earlier times: each part goes on by its mean's path."""
        positions = paths[-1].copy()
        if len(times) < 2:
            return positions
        span = max(float(np.abs(times - times[-1]).max()), 1e-9)
        powers = np.arange(2 if len(times) < 4 else 3)
        basis, at = ((times - times[-1]) / span)[:, None] ** powers, ((t - times[-1]) / span) ** powers
        for part in self._parts:
            centers = paths[:, part.members].mean(axis=1)
            ways = np.linalg.norm(np.diff(centers, axis=0), axis=1)
            part.speed = float(ways.mean())
            if np.abs(centers[-1]).max() <= self._clouds.half_side:  # it has not left the box
                step = at @ np.linalg.lstsq(basis, centers, rcond=None)[0] - centers[-1]
                longest = 1.5 * float(ways.max())
                positions[part.members] += step * min(1.0, longest / max(float(np.linalg.norm(step)), 1e-9))
        return positions

    def _register(self, positions: Floats, i: int) -> Floats:
        """Positions (n, 3) of the tracks' points among the points of time i, from a prediction, which is changed, and
        from where the parts' centers are expected."""
        points = self._clouds.clouds[i].thinned(160)
        if len(points.scores) == 0:
            return positions
        free = np.ones(len(points.scores), np.float32)
        for part in self._parts:
            free *= 1.0 - 0.9 * self._search(part, positions, points, free, i)
        data, weights = points.positions, points.scores[:, None]
        alike = 0.2 + 0.8 * np.exp(-_sq_distances(points.colors, self.colors) / (2 * 0.3**2))
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            spread = self._unit * WIDE ** (1 - share) * NARROW**share
            belongs = alike * np.exp(-_sq_distances(data, positions) / (2 * spread**2))
            belongs *= weights / (belongs.sum(axis=1, keepdims=True) + NOISE)
            mass = belongs.sum(axis=0)[:, None]
            kernel = self._stiff if share < 0.6 else self._soft
            positions = positions + (kernel @ (belongs.T @ data - mass * positions)) / (kernel @ mass + 1e-2)
        return positions

    def _search(self, part: _Part, positions: Floats, points: Points, free: Floats, i: int) -> Floats:
        """Shift a part in `positions` to where it explains most of the points of time i, around where it is and around
        where its center is expected; (m,) how well it explains each point there."""
        widening = min(max(1.0, FAST * part.speed / (SEARCH * self._unit)), 2.0)
        reach = 1.5 if abs(i - self._key) == 1 else widening + 0.25 * min(part.lost, 4)
        starts = [np.zeros(3, np.float32)]
        if part.expected is not None:
            starts.append(part.expected[i] - positions[part.members].mean(axis=0))
        reaches, spreads = np.array([reach, 1.0], np.float32), np.array([widening, 1.0]) * PRIOR * self._unit
        some = part.members[evenly_indices(len(part.members), 24)]
        pairs = 0.3 + 0.7 * np.exp(-_sq_distances(points.colors, self.colors[some]) / (2 * 0.35**2))

        def explained(shifts: Floats, spread: float) -> tuple[Floats, NDArray[np.float64], Floats]:
            """(s,) how much of the points the part explains when it is moved by each of the shifts (s, 3), (s,) how
            likely these are, and (s, m) how near it then is to each of the points. spread: standard deviation, UNIT."""
            moved = (points.positions.T[:, None] - shifts.T[:, :, None]).reshape(3, -1)
            nearest, squared = _nearest(moved, positions[some])
            near = np.exp(-squared / (2 * (spread * self._unit) ** 2)).reshape(len(shifts), -1)
            alike = pairs[np.arange(len(points.colors)), nearest.reshape(near.shape)]
            around = zip(starts, spreads, strict=False)
            prior = [np.exp(-((shifts - at) ** 2).sum(axis=1) / (2 * width**2)) for at, width in around]
            return (near * alike * free * points.scores).sum(axis=1), np.max(prior, axis=0), near

        rough: NDArray[Any] = self._unit * ROUGH
        fine: NDArray[Any] = self._unit * FINE
        shifts = np.concatenate([start + scale * rough for start, scale in zip(starts, reaches, strict=False)])
        scores, likely, _ = explained(shifts, 0.9)
        chosen = np.argsort(-scores * likely, kind="stable")[:4]
        scale = reaches[chosen // len(rough)][:, None, None]
        shifts = (shifts[chosen][:, None] + scale * fine).reshape(-1, 3)
        scores, likely, near = explained(shifts, 0.5)
        best = int((scores * likely).argmax())
        if part.usual and scores[best] < LOST * np.median(part.usual):
            part.lost += 1
            positions[part.members] += starts[-1]
            return np.zeros(len(free), np.float32)
        part.usual.append(float(scores[best]))
        part.lost = 0
        positions[part.members] += shifts[best]
        return near[best]


def _nearest(a: Floats, b: Floats) -> tuple[NDArray[np.uint8], Floats]:
    """For each column of a (3, n) the index of the nearest row of b (m, 3), m at most 255, and the squared distance.

    NumPy is many times as fast along rows of length n as along rows of length m.
    """
    # Half of |a|² - |a - b|²: one product of matrices, largest where b is nearest.
    closeness = np.column_stack([b, -0.5 * (b**2).sum(axis=1)]) @ np.concatenate([a, np.ones_like(a[:1])])
    largest = closeness.max(axis=0)
    numbers = np.arange(len(b), dtype=np.uint8)[:, None]
    nearest = ((closeness < largest) * np.uint8(255) | numbers).min(axis=0)
    x, y, z = a**2
    squared: Floats = x + y + z - 2 * largest
    return nearest, np.maximum(squared, 0.0)


def _sq_distances(a: Floats, b: Floats) -> Floats:
    """(n, m) squared distances of rows (n, d) and (m, d)."""
    product: Floats = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * (a @ b.T)
    return np.maximum(product, 0.0)
