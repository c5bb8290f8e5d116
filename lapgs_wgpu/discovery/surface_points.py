"""Points on the surfaces that move: rays of moving pixels, at depths on which images of neighbouring times agree.

Cameras of neighbouring times see a moving object from other sides while it has hardly moved: its silhouettes meet in
space. Where cameras move slowly, they meet at a depth that the object's own motion feigns. Such votes are blurred along
the ray, until the middle of the scene is as good a place as any. Places that differ at all times hold texture that the
static fit blurs. They get no points.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lapgs_wgpu.data.evenly import evenly_indices
from lapgs_wgpu.discovery.residual import Floats, Residual, cubic_grid

RAYS = 300  # of an image, at most
DEPTHS = 64  # that are tried along a ray
NEIGHBORS = 6  # images that vote on a depth, those nearest in time
SPAN = 1.0  # time steps, at which a vote counts half
COLOR_SPREAD = 0.25  # standard deviation of the colors of one surface in several images
COLOR_SHARE = 0.7  # of a vote that depends on the color
GRID = 48  # cells along an axis of the grid of what is residual at all times
ALWAYS, ALWAYS_WIDTH = 0.8, 0.25  # share of all images, above which a residual is no motion; width of the transition
LEAST_SCORE = 0.5  # of a point
MOTION = 0.05  # box half sides; way from one time to the next that a depth must allow for
MIDDLE = 2.0  # box half sides; standard deviation of depths around that of the middle of the scene
PLATEAU = 0.1  # scores within this share of the best one count as equal; their middle is taken
LONELY = 0.12  # box half sides; a point is dropped whose fourth neighbour is further


class Points(NamedTuple):
    """Surface points of one time: positions (n, 3) world units, colors (n, 3), scores (n,) in [0, 1]."""

    positions: Floats
    colors: Floats
    scores: Floats

    def chosen(self, rows: NDArray[Any]) -> Points:
        """The points of an index or a mask (n,)."""
        return Points(*(values[rows] for values in self))

    def thinned(self, most: int) -> Points:
        """At most `most` of the points, evenly chosen."""
        return self.chosen(evenly_indices(len(self.scores), most))


def merged(parts: Iterable[Points]) -> Points:
    """All points of several sets, at least one, in their order."""
    return Points(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class PointClouds(NamedTuple):
    """The surface points of all times (T,), ascending, and the cloud of each. tint: how far apart points of one place
    are that differ by 1 in color, world units, where their colors tell things that touch."""

    times: NDArray[np.float64]
    clouds: tuple[Points, ...]
    tint: float = 0.0

    @property
    def total(self) -> int:
        """Number of points over all times."""
        return sum(len(cloud.scores) for cloud in self.clouds)


def surface_points(images: Sequence[Residual], half_side: float) -> PointClouds:
    """Surface points of what moves, for each distinct time of the images, within [-half_side, half_side]^3."""
    always = _Always(images, half_side)
    found = [_points(image, _neighbors(images, i), always, half_side) for i, image in enumerate(images)]
    times = np.unique([image.time for image in images])
    clouds = []
    for time in times:
        clouds.append(
            _dense(merged(points for points, image in zip(found, images, strict=True) if image.time == time), half_side)
        )
    return PointClouds(times, tuple(clouds))


class _Neighbor(NamedTuple):
    """An image of a near time. lapse: until then, in time steps. weight: of its vote."""

    image: Residual
    lapse: float
    weight: float

    def doubt(self, eye: Floats, half_side: float) -> float:
        """Standard deviation of the depths, world units, at which things in the middle of the scene seem to be that
        move while a camera goes from `eye` (3,) to this one."""
        parallax = np.linalg.norm(self.image.camera.position - eye) / max(float(np.linalg.norm(eye)), 1e-6)
        return MOTION * half_side * self.lapse / max(float(parallax), 1e-6)


def _neighbors(images: Sequence[Residual], of: int) -> list[_Neighbor]:
    """The images that are nearest in time."""
    times = np.array([image.time for image in images])
    distinct = np.unique(times)
    step = float(np.diff(distinct).mean()) if len(distinct) > 1 else 1.0
    lapses = np.abs(times - times[of]) / step
    order = [i for i in np.lexsort((np.arange(len(times)), lapses)) if i != of][:NEIGHBORS]
    return [_Neighbor(images[i], float(lapses[i]), float(1.0 / (1.0 + (lapses[i] / SPAN) ** 2))) for i in order]


def _points(image: Residual, neighbors: list[_Neighbor], always: _Always, half_side: float) -> Points:
    rays = image.rays(RAYS)
    if len(rays.directions) == 0 or not neighbors:
        empty = np.zeros((0, 3), np.float32)
        return Points(empty, empty, np.zeros(0, np.float32))
    eye = image.camera.position.astype(np.float32)
    depths = _depths(eye, rays.directions, half_side)
    places = eye + depths[..., None] * rays.directions[:, None]
    length = np.linalg.norm(rays.directions, axis=1, keepdims=True)
    spacing = float(np.median(length[:, 0] * (depths[:, 1] - depths[:, 0])))
    votes, tolerant, weights = np.zeros(depths.shape), np.zeros(depths.shape), np.zeros(depths.shape)
    for neighbor in neighbors:
        samples = neighbor.image.sample(places)
        sq_distances = ((samples.colors - rays.blurred[:, None]) ** 2).sum(axis=2)
        agreement = 1.0 - COLOR_SHARE + COLOR_SHARE * np.exp(-sq_distances / (2 * COLOR_SPREAD**2))
        vote = neighbor.weight * samples.mask * agreement
        votes += vote
        tolerant += _blur_along_rays(vote, neighbor.doubt(eye, half_side) / spacing)
        weights += neighbor.weight * samples.inside
    known = np.clip((ALWAYS - always.at(places)) / ALWAYS_WIDTH, 0.0, 1.0) / np.maximum(weights, 1e-6)
    known[weights < 0.5 * sum(neighbor.weight for neighbor in neighbors)] = 0.0  # hardly seen by others
    scores = votes * known
    past_middle = (places * rays.directions[:, None]).sum(axis=2) / length
    middle = _middle_of_best(tolerant * known * np.exp(-0.5 * (past_middle / (MIDDLE * half_side)) ** 2))
    row = np.arange(len(scores))
    low = np.floor(middle).astype(np.int64)
    depth = depths[row, low] + (middle - low) * (depths[:, 1] - depths[:, 0])
    positions = eye + depth[:, None] * rays.directions
    kept = scores.max(axis=1) > LEAST_SCORE
    return Points(positions[kept].astype(np.float32), rays.colors[kept], scores.max(axis=1)[kept].astype(np.float32))


def _blur_along_rays(votes: NDArray[np.floating], spread: float) -> NDArray[np.floating]:
    """Votes (n, DEPTHS) along each ray, blurred by a Gaussian of this standard deviation, in depths."""
    if spread < 0.1:
        return votes
    if spread > DEPTHS:
        return np.broadcast_to(votes.mean(axis=1, keepdims=True), votes.shape)
    return ndimage.gaussian_filter1d(votes, spread, axis=1, mode="nearest", truncate=3.0)


def _depths(eye: Floats, directions: Floats, half_side: float) -> Floats:
    """(n, DEPTHS) depths at which rays lie in the box; beside it a single one, many times."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half_side - eye) / directions, (half_side - eye) / directions
    near = np.nan_to_num(np.minimum(a, b).max(axis=1)).clip(1e-2)
    far = np.maximum(np.nan_to_num(np.maximum(a, b).min(axis=1)), near + 1e-3)
    steps = (np.arange(DEPTHS, dtype=np.float32) + 0.5) / DEPTHS
    return (near[:, None] + (far - near)[:, None] * steps).astype(np.float32)


def _middle_of_best(scores: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n,) index of the middle of the run of nearly best scores (n, k) around each best one."""
    best, index = scores.argmax(axis=1)[:, None], np.arange(scores.shape[1])[None]
    worse = scores < (1.0 - PLATEAU) * scores.max(axis=1, keepdims=True)
    first = np.where(worse & (index < best), index, -1).max(axis=1) + 1
    last = np.where(worse & (index > best), index, scores.shape[1]).min(axis=1) - 1
    return 0.5 * (first + last)


def _dense(points: Points, half_side: float) -> Points:
    """The points without isolated ones."""
    if len(points.scores) < 5:
        return points.thinned(0)
    distances, _ = cKDTree(points.positions).query(points.positions, k=5)
    return points.chosen(distances[:, 4] < LONELY * half_side)


def parts_of(points: Points, link: float, tint: float) -> NDArray[np.int64]:
    """(n,) number of the connected part of each point, where points closer than `link` are connected. tint: of
    `PointClouds`."""
    positions = np.hstack([points.positions, tint * points.colors]) if tint else points.positions
    pairs, count = cKDTree(positions).query_pairs(link, output_type="ndarray"), len(positions)
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


class _Always:
    """The share of images in which a place is residual, on a grid over the box."""

    def __init__(self, images: Sequence[Residual], half_side: float) -> None:
        self._half_side = half_side
        places = cubic_grid(((np.arange(GRID, dtype=np.float32) + 0.5) / GRID * 2 - 1) * half_side).astype(np.float32)
        total, count = np.zeros(len(places), np.float32), np.zeros(len(places), np.float32)
        for image in images:
            samples = image.sample(places)
            total += samples.mask
            count += samples.inside
        self._share = (total / np.maximum(count, 1.0)).reshape(GRID, GRID, GRID)

    def at(self, points: Floats) -> Floats:
        """At points (..., 3), interpolated."""
        index = (points / self._half_side + 1) * 0.5 * GRID - 0.5
        return ndimage.map_coordinates(self._share, np.moveaxis(index, -1, 0), order=1, mode="nearest")
