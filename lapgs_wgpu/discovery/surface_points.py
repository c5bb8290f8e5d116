"""Points on the surfaces that move: rays of moving pixels, at depths on which images of neighbouring times agree.

Cameras of neighbouring times see a moving object from other sides while it has hardly moved: its silhouettes meet in
space. Where cameras move slowly, they meet at a depth that the object's own motion feigns. Such votes are blurred along
the ray, until the middle of the scene is as good a place as any. Places that differ at all times hold texture that the
static fit blurs. They get no points.
"""

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

DEPTHS = 64  # that are tried along a ray
COLOR_SPREAD = 0.25  # standard deviation of the colors of one surface in several images
COLOR_SHARE = 0.7  # of a vote that depends on the color
GRID = 48  # cells along an axis of the grid of what is residual at all times
ALWAYS, ALWAYS_WIDTH = 0.8, 0.25  # share of all images, above which a residual is no motion; width of the transition
PLATEAU = 0.1  # scores within this share of the best one count as equal; their middle is taken
# In half sides of the box, 1.3 in the presets:
MOTION = 0.05  # way from one time to the next that a depth must allow for
MIDDLE = 2.0  # standard deviation of depths around that of the middle of the scene
LONELY = 0.12  # a point is dropped whose fourth neighbour is further
LINK = 0.11  # points closer than this are of one part


class Points(NamedTuple):
    """Surface points of one time: positions (n, 3) world units, colors (n, 3), scores (n,) in [0, 1]."""

    positions: Floats
    colors: Floats
    scores: Floats

    def chosen(self, rows: NDArray[Any]) -> "Points":
        """The points of an index or a mask (n,)."""
        return Points(*(values[rows] for values in self))

    def thinned(self, most: int) -> "Points":
        """At most `most` of the points, evenly chosen."""
        return self.chosen(evenly_indices(len(self.scores), most))


def merged(parts: Iterable[Points]) -> Points:
    """All points of several sets, at least one, in their order."""
    return Points(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class PointClouds(NamedTuple):
    """The surface points of all times (T,), ascending, and the cloud of each, within [-half_side, half_side]^3. tint:
    how far apart, world units, points of one place are that differ by 1 in color, where that tells what touches."""

    times: NDArray[np.float64]
    clouds: tuple[Points, ...]
    half_side: float
    tint: float = 0.0

    @property
    def total(self) -> int:
        """Number of points over all times."""
        return sum(len(cloud.scores) for cloud in self.clouds)

    def parts(self, points: Points) -> NDArray[np.int64]:
        """(n,) number of the connected part of each of some points, where points closer than LINK are connected."""
        positions = np.hstack([points.positions, self.tint * points.colors]) if self.tint else points.positions
        pairs = cKDTree(positions).query_pairs(LINK * self.half_side, output_type="ndarray")
        graph = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(positions), len(positions)))
        return connected_components(graph, directed=False)[1].astype(np.int64)

    def nearest(self, paths: Floats) -> list[tuple[NDArray[np.float64], NDArray[np.int64]]]:
        """For each time the distances (n,) of its points to the nearest track, paths (T, m, 3), and its number (n,)."""
        return [cKDTree(path).query(points.positions) for path, points in zip(paths, self.clouds, strict=True)]


def surface_points(images: Sequence[Residual], half_side: float) -> PointClouds:
    """Surface points of what moves, for each distinct time of the images, within [-half_side, half_side]^3."""
    always = _always(images, half_side)
    taken = np.array([image.time for image in images])
    times = np.unique(taken)
    step = float(np.diff(times).mean()) if len(times) > 1 else 1.0
    found: list[list[Points]] = [[] for _ in times]
    for i, image in enumerate(images):
        lapses = np.abs(taken - image.time) / step
        nearest = [n for n in np.argsort(lapses, kind="stable") if n != i][:6]
        neighbors = [(images[n], float(lapses[n])) for n in nearest]
        found[np.searchsorted(times, image.time)].append(_points(image, neighbors, always, half_side))
    clouds = []
    for points in map(merged, found):
        distances, _ = cKDTree(points.positions).query(points.positions, k=5)
        clouds.append(points.chosen(distances[:, 4] < LONELY * half_side))
    return PointClouds(times, tuple(clouds), half_side)


def _points(image: Residual, neighbors: list[tuple[Residual, float]], always: Floats, half_side: float) -> Points:
    """neighbors: images and how many time steps they are apart. always: of `_always`."""
    directions, blurred, colors = image.rays(300)
    if not len(directions):
        return Points(directions, colors, directions[:, 0])
    eye = image.camera.position.astype(np.float32)
    depths = _depths(eye, directions, half_side)
    places = eye + depths[..., None] * directions[:, None]
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    spacing = float(np.median(length[:, 0] * (depths[:, 1] - depths[:, 0])))
    votes, tolerant, weights = np.zeros((3, *depths.shape))
    most = 0.0
    for neighbor, lapse in neighbors:
        weight = 1.0 / (1.0 + lapse**2)  # a half at one time step
        mask, shown, inside = neighbor.sample(places)
        sq_distances = ((shown - blurred[:, None]) ** 2).sum(axis=2)
        agreement = 1.0 - COLOR_SHARE + COLOR_SHARE * np.exp(-sq_distances / (2 * COLOR_SPREAD**2))
        vote = weight * mask * agreement
        votes += vote
        # Standard deviation of the depths at which things seem to be that move while the camera goes to the neighbor.
        parallax = float(np.linalg.norm(neighbor.camera.position - eye)) / max(float(np.linalg.norm(eye)), 1e-6)
        spread = MOTION * half_side * lapse / max(parallax, 1e-6) / spacing
        if spread > DEPTHS:
            tolerant += vote.mean(axis=1, keepdims=True)
        else:
            tolerant += ndimage.gaussian_filter1d(vote, max(spread, 0.1), axis=1, mode="nearest", truncate=3.0)
        weights += weight * inside
        most += weight
    at = np.moveaxis((places / half_side + 1) * 0.5 * GRID - 0.5, -1, 0)
    share = ndimage.map_coordinates(always, at, order=1, mode="nearest")
    known = np.clip((ALWAYS - share) / ALWAYS_WIDTH, 0.0, 1.0) / np.maximum(weights, 1e-6)
    known[weights < 0.5 * most] = 0.0  # hardly seen by others
    scores = votes * known
    past_middle = (places * directions[:, None]).sum(axis=2) / length
    middle = _middle_of_best(tolerant * known * np.exp(-0.5 * (past_middle / (MIDDLE * half_side)) ** 2))
    low = np.floor(middle).astype(np.int64)
    depth = depths[np.arange(len(scores)), low] + (middle - low) * (depths[:, 1] - depths[:, 0])
    positions = eye + depth[:, None] * directions
    best = scores.max(axis=1)
    return Points(positions.astype(np.float32), colors, best.astype(np.float32)).chosen(best > 0.5)


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


def _always(images: Sequence[Residual], half_side: float) -> Floats:
    """(GRID, GRID, GRID) the share of images in which a place of the box is residual."""
    places = cubic_grid(((np.arange(GRID, dtype=np.float32) + 0.5) / GRID * 2 - 1) * half_side).astype(np.float32)
    total, count = np.zeros((2, len(places)), np.float32)
    for image in images:
        mask, _, inside = image.sample(places)
        total += mask
        count += inside
    return np.divide(total, np.maximum(count, 1.0), dtype=np.float32).reshape(GRID, GRID, GRID)
