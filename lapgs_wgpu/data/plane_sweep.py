"""Surfaces that cameras see, by a plane sweep between neighbors: where Gaussians of a capture without a cloud start.

The median of a still camera's images over the clip shows what does not move. Where a plane before a camera, at the
depth of a surface, carries the other cameras' images to it, they look as its own there. A depth is believed that other
cameras' depths confirm, and beyond which fewer of them see. Between believed depths, blank surfaces are filled in: a
plane's inverse depth is linear in the image, and so the solution of Laplace's equation; it spreads less across edges of
color. Sources: Collins, A space-sweep approach to true multi-image matching (CVPR 1996); Levin et al., Colorization
using optimization (SIGGRAPH 2004).
"""

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from lapgs_wgpu.data.cloud import points_at
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.views import Dataset, small_views
from lapgs_wgpu.progress import counted, say
from lapgs_wgpu.splat.camera import Array, Camera

Floats = NDArray[np.float32]

SIDE = 128  # pixels, of the images that are compared
IMAGES = 25  # of a camera, whose median shows what stands still
CAMERAS = 32  # at most
NEIGHBORS = 4  # the nearest cameras, with which one is compared
BASELINE = 0.02  # of the nearest depth: a camera that stands nearer by sees no parallax
DEPTHS = 96  # planes, evenly in 1 / depth
WINDOW = 7  # pixels; side of the square whose colors are compared
MIN_CORRELATION = 0.6  # normalized cross-correlation of a surface's image in two cameras
CONFIRMED = 2  # other cameras that must find the same depth
NEAR = 2.5  # planes by which two cameras' depths may differ
PATCH = 12  # pixels of a window at about one depth: fewer are chance
EDGE = 0.05  # difference of two colors across which depths hardly spread
HELD = 1e3  # weight of believed depths, relative to those of their neighbors
MOVED = 0.08  # difference of a color from the median from which on something moves there
MOVER_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a rig's clip, at which what moves is searched for
FLAT = 1e-8  # product of two variances, below which windows are flat and look like nothing


class Surface(NamedTuple):
    """points: (N, 3) world units. colors: (N, 3) in [0, 1]. share: of all pixels, those at which a point lies."""

    points: Floats
    colors: Floats
    share: float


class _Still(NamedTuple):
    """A camera, and what it sees that does not move: colors (H, W, 3) in [0, 1], their gray (H, W), and its mean and
    variance (H, W) over the window of each pixel."""

    camera: Camera
    colors: Floats
    gray: Array
    mean: Array
    variance: Array


@lru_cache(maxsize=2)
def still_surface(dataset: Dataset) -> Surface | None:
    """The surfaces that the training cameras see, a point a pixel. Says what was found.

    None where there are fewer than three cameras, where nothing states how deep they see, and where no surface is
    found. Raises InputError where an image cannot be read.
    """
    if dataset.depths is None or len(dataset.cameras) < 3:
        return None
    stills = _stills(dataset)
    places, colors, kept = _surfaces(stills, dataset.depths)
    found, share = [(places[kept], colors[kept])], float(kept.mean(axis=1).mean())
    text = f"start: {len(found[0][0])} points on surfaces, {share:.0%} of the pixels of {len(stills)} cameras"
    if dataset.is_rig:
        for time in np.quantile(dataset.times, MOVER_TIMES):
            now = _stills(dataset, at=float(time))
            changes = [np.abs(one.colors - still.colors).mean(axis=2) for one, still in zip(now, stills, strict=True)]
            moved = np.stack([_box(change).ravel() > MOVED for change in changes])
            if moved.any():
                places, colors, kept = _surfaces(now, dataset.depths)
                found.append((places[kept & moved], colors[kept & moved]))
        if more := sum(len(points) for points, _ in found[1:]):
            text += f", and {more} on what moves, at {len(MOVER_TIMES)} times"
    say(text)
    points, rgb = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    return Surface(points, rgb, share) if share else None


def _surfaces(stills: list[_Still], bounds: tuple[float, float]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Of each camera a point for each pixel (cameras, H W, 3), its color (cameras, H W, 3), and whether a surface is
    there (cameras, H W). bounds: nearest and furthest depth, world units."""
    near, far = bounds
    planes = np.linspace(1 / far, 1 / near, DEPTHS)
    with ThreadPoolExecutor() as threads:
        swept = threads.map(partial(_sweep, stills=stills, planes=planes, least=BASELINE * near), stills)
        maps = list(counted(swept, len(stills), "cameras searched for surfaces"))
    tolerance = NEAR * (planes[1] - planes[0])
    known = _confirmed(stills, maps, tolerance)
    filled = [_filled(still, depths) for still, depths in zip(stills, known, strict=True)]
    points, surfaces = [], []
    for still, depths, believed in zip(stills, filled, known, strict=True):
        places = _places(still.camera, depths)
        agreeing, _ = _votes(places, still, stills, filled, tolerance)
        _, beyond = _votes(places, still, stills, known, tolerance)
        points.append(places.astype(np.float32))
        confirmed = np.isfinite(depths.ravel()) & (agreeing >= CONFIRMED) & (beyond == 0)
        surfaces.append(np.isfinite(believed.ravel()) | confirmed)
    return np.stack(points), np.stack([still.colors.reshape(-1, 3) for still in stills]), np.stack(surfaces)


def _stills(dataset: Dataset, at: float | None = None) -> list[_Still]:
    """at: the time whose images are taken instead of the median of all."""
    stills = []
    for camera in evenly(dataset.cameras, CAMERAS):
        views = sorted((view for view in dataset.train if view.camera is camera), key=lambda view: view.time)
        chosen = evenly(views, IMAGES) if at is None else [min(views, key=lambda view: abs(view.time - at))]
        small = small_views(chosen, SIDE)
        colors = (np.median([view.load()[..., :3] for view in small], axis=0) / 255).astype(np.float32)
        gray = colors.mean(axis=2, dtype=np.float64)
        mean = _box(gray)
        stills.append(_Still(small[0].camera, colors, gray, mean, _box(gray**2) - mean**2))
    return stills


def _sweep(still: _Still, stills: list[_Still], planes: Array, least: float) -> Array:
    """(H, W) the inverse depth at which the better half of the neighbors sees the same; NaN where none does. least:
    distance of a neighbor, world units."""
    apart = [float(np.linalg.norm(other.camera.position - still.camera.position)) for other in stills]
    order = [i for i in np.argsort(apart, kind="stable") if apart[i] > least][:NEIGHBORS]
    if len(order) < 2:
        return np.full(still.gray.shape, np.nan)
    scores = np.stack([_likeness(still, [stills[i] for i in order], plane) for plane in planes])
    best = scores.argmax(axis=0)[None]
    score = np.take_along_axis(scores, best, 0)
    before, after = (np.take_along_axis(scores, (best + k).clip(0, len(planes) - 1), 0) for k in (-1, 1))
    bend = before - 2 * score + after
    between = (bend < 0) & (best > 0) & (best < len(planes) - 1)
    shift = np.where(between, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0).clip(-0.5, 0.5)
    inverse = planes[best] + shift * (planes[1] - planes[0])
    return np.where(score >= MIN_CORRELATION, inverse, np.nan)[0]


def _likeness(still: _Still, others: list[_Still], plane: float) -> Array:
    """(H, W) mean correlation with the better half of the others at this inverse depth; -1 where fewer than two see."""
    correlations = []
    for other in others:
        there = _carried(other, still.camera, plane)
        its_mean = _box(there)
        both = still.variance * (_box(there**2) - its_mean**2)
        likeness = (_box(still.gray * there) - still.mean * its_mean) / np.sqrt(np.maximum(both, FLAT))
        correlations.append(np.where(there >= 0, likeness, np.nan))
    ordered = np.sort(correlations, axis=0)  # NaN last
    seeing = np.isfinite(ordered).sum(axis=0)
    taken = np.maximum(2, (seeing + 1) // 2)
    sums = np.concatenate([np.zeros((1, *still.gray.shape)), np.cumsum(np.nan_to_num(ordered), axis=0)])
    all_of, worse = (np.take_along_axis(sums, k[None], 0)[0] for k in (seeing, np.maximum(seeing - taken, 0)))
    return np.where(seeing >= 2, (all_of - worse) / taken, -1.0)


def _carried(other: _Still, camera: Camera, plane: float) -> Array:
    """(H, W) the gray of another camera at the points of a plane across this camera's axis; -1 where it sees none.

    plane: 1 / depth. The plane's homography is K' (R K^-1 + t e3^T / depth).
    """
    relative = other.camera.T_cam_world @ np.linalg.inv(camera.T_cam_world)
    H = relative[:3, :3] @ np.linalg.inv(camera.K)
    H[:, 2] += plane * relative[:3, 3]
    H = other.camera.K @ H
    scaled = (H / (H[2, 2] if abs(H[2, 2]) > 1e-9 else 1e-9)).ravel()[:8]
    size = camera.width, camera.height
    image = Image.fromarray(other.gray.astype(np.float32))
    there = image.transform(size, Image.Transform.PERSPECTIVE, scaled, Image.Resampling.BILINEAR, fillcolor=-1)
    y, x = np.ogrid[: camera.height, : camera.width]
    ahead = H[2, 0] * (x + 0.5) + H[2, 1] * (y + 0.5) + H[2, 2] > 1e-9
    return np.where(ahead, np.asarray(there, np.float64), -1.0)


def _box(image: Array) -> Array:
    return ndimage.uniform_filter(image, WINDOW, mode="nearest")


def _places(camera: Camera, inverse: Array) -> Array:
    """(H W, 3) the points at the middles of the pixels, world units. inverse: depths (H, W), 1 where they are NaN."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return points_at(camera, np.column_stack([x.ravel(), y.ravel()]), 1 / np.nan_to_num(inverse, nan=1.0).ravel())


def _votes(places: Array, still: _Still, stills: list[_Still], maps: list[Array], most: float) -> tuple[Array, Array]:
    """How many other cameras see a surface at the points (N, 3) of a camera, and how many see one beyond: (N,) each.

    maps: inverse depths (H, W) of the cameras, NaN where unknown. most: by which they may differ.
    """
    agreeing, beyond = np.zeros((2, len(places)))
    for other, depths in zip(stills, maps, strict=True):
        if other is still:
            continue
        pixels, depth = other.camera.project(places)
        size = other.camera.width, other.camera.height
        inside = (depth > 1e-9) & ((pixels >= 0) & (pixels < size)).all(axis=1)
        x, y = np.where(inside[:, None], pixels, 0).astype(np.int64).T
        nearer = 1 / np.where(inside, depth, 1.0) - depths[y, x]  # NaN compares as false
        agreeing += inside & (np.abs(nearer) < most)
        beyond += inside & (nearer > 2 * most)
    return agreeing, beyond


def _confirmed(stills: list[_Still], maps: list[Array], most: float) -> list[Array]:
    """(H, W) of each camera: inverse depths, in patches, that others confirm and fewer see through; NaN elsewhere."""
    known = []
    for still, depths in zip(stills, maps, strict=True):
        votes = _votes(_places(still.camera, depths), still, stills, maps, most)
        agreeing, beyond = (each.reshape(depths.shape) for each in votes)
        kept = np.where((agreeing >= CONFIRMED) & (agreeing > beyond), depths, np.nan)
        padded = np.pad(kept, WINDOW // 2, constant_values=np.nan)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (WINDOW, WINDOW))
        near = (np.abs(windows - kept[..., None, None]) < most).sum(axis=(2, 3))
        known.append(np.where(near >= PATCH, kept, np.nan))
    return known


def _filled(still: _Still, known: Array) -> Array:
    """(H, W) inverse depths, NaN filled by Laplace's equation with weights that fall across edges; or all NaN."""
    held = np.isfinite(known).ravel()
    if not held.any():
        return known
    number = np.arange(known.size).reshape(known.shape)
    first = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    second = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    colors = still.colors.reshape(-1, 3).astype(np.float64)
    weights = np.exp(-((colors[first] - colors[second]) ** 2).sum(axis=1) / (2 * EDGE**2)) + 1e-3
    links = sparse.coo_matrix((weights, (first, second)), shape=(known.size, known.size)).tocsr()
    links = links + links.T
    total = np.asarray(links.sum(axis=1)).ravel() + HELD * held
    return spsolve((sparse.diags(total) - links).tocsc(), HELD * np.nan_to_num(known.ravel())).reshape(known.shape)
