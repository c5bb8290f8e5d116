"""The point cloud of a capture, at which Gaussians start, and which cameras see its points."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply_elements import BAD_SHARE, Floats, open_ply, read_colors
from lapgs_wgpu.splat.camera import Array, Camera

CAMERA_SAMPLES = 64  # cameras that suffice to determine which points are seen
DENSITY, MIN_CELLS = 8, 4  # points per cell, on average; cells along an axis
FILLED = 0.95  # share of cells with points from which on a cloud is random: the surfaces of a scene leave most empty


class Cloud(NamedTuple):
    """points: (N, 3) float32 in world units; float64 in the units of files, which may lie far from their origin.
    colors: (N, 3) float32, RGB in [0, 1]."""

    points: NDArray[Any]
    colors: NDArray[np.float32]

    def at_most(self, count: int, seed: int) -> "Cloud":
        """Return at most `count` points: all of them, or a random subset in their order."""
        if len(self.points) <= count:
            return self
        chosen = np.sort(np.random.default_rng(seed).choice(len(self.points), count, replace=False))
        return Cloud(self.points[chosen], self.colors[chosen])


def find_cloud(folder: Path, patterns: Sequence[str]) -> Path | None:
    """Find the last file by name of the first pattern that matches any."""
    return next((found[-1] for pattern in patterns if (found := sorted(folder.glob(pattern)))), None)


def read_cloud(path: Path) -> Cloud:
    """Read a .npy or a .ply file; points without colors are mid-gray. Raises InputError."""
    points, colors = (read_npy(path), None) if path.suffix == ".npy" else read_points(path)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"{path} must hold at least one point of 3 numbers, an array of (N, 3), got {points.shape}.")
    points = points.astype(np.float64)  # float32 would round what lies far from the origin, before it is centered
    cloud = Cloud(points, np.full(points.shape, 0.5, np.float32) if colors is None else colors)
    good = (np.abs(points) <= np.finfo(np.float32).max).all(axis=1)  # false for NaN, too
    if bad := len(points) - int(good.sum()):
        told = f"{path} holds NaN or infinite coordinates in {bad} of {len(points)} points"
        if bad > BAD_SHARE * len(points):
            raise InputError(f"{told}, first in point {good.argmin()}; remove them.")
        print(f"note: {told}, which are left out.", file=sys.stderr)
        return Cloud(points[good], cloud.colors[good])
    return cloud


def read_points(path: Path) -> tuple[Array, Floats | None]:
    """Read positions (N, 3) of a .ply file, and colors (N, 3) in [0, 1], None where it has none that are known.

    Positions may be NaN or infinite. Raises InputError if the file is not a point cloud.
    """
    with open_ply(path) as ply:
        vertex = ply.elements.get("vertex")
        if vertex is None or not {"x", "y", "z"} <= set(vertex.properties):
            raise InputError(f"{path}: has no element vertex with properties x, y, z, so it is no cloud of points.")
        points, colors = ply.columns(vertex, ["x", "y", "z"], np.float64), read_colors(ply, vertex)
        others = [name for name in vertex.properties if name not in ("x", "y", "z", "nx", "ny", "nz")]
        if colors is None and others:
            print(
                f"note: {path}: no colors are known in the properties {', '.join(others[:5])}; points start gray.",
                file=sys.stderr,
            )
        return points, colors


def read_npy(path: Path) -> NDArray[np.floating]:
    """Read a .npy file of numbers. Raises InputError."""
    try:
        # Memory-mapped: a declared shape must not allocate memory before it is compared with the file size.
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        array = np.array(mapped) if isinstance(mapped, np.ndarray) else None
    except Exception as error:  # NumPy passes a damaged header to Python's parser, with all its errors
        reason = str(error)[:200]
        raise InputError(f"{path} cannot be read as a NumPy array ({reason}); copy or make it again.") from None
    if array is None or array.dtype.kind not in "fiu":
        what = "an archive" if array is None else array.dtype
        raise InputError(f"{path} must hold an array of numbers, got {what}.")
    return array


def views_of(points: Array, cameras: Sequence[Camera], near: float = 0.0, far: float = np.inf) -> NDArray[np.int64]:
    """Count the cameras, of at most CAMERA_SAMPLES, that see each point (N, 3) at depths between near and far: (N,)."""
    seen = np.zeros(len(points), dtype=np.int64)
    for camera in evenly(cameras, CAMERA_SAMPLES):
        depths, inside = in_view(points, camera)
        seen += inside & (depths >= near) & (depths <= far)
    return seen


def in_view(points: NDArray[np.floating], camera: Camera) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Project points (N, 3): their depths (N,), NaN behind the camera, and a mask (N,) of those inside the image."""
    pixels, depths = camera.project(points)
    ahead = depths > 0
    within = (pixels >= 0) & (pixels < [camera.width, camera.height])
    return np.where(ahead, depths, np.nan), ahead & within[:, 0] & within[:, 1]


def points_at(camera: Camera, pixels: Array, depths: Array) -> Array:
    """The points (N, 3), world units, that a camera sees at pixels (N, 2) and depths (N,)."""
    rays = np.linalg.solve(camera.K, np.column_stack([pixels, np.ones(len(pixels))]).T)
    return ((rays * depths).T - camera.T_cam_world[:3, 3]) @ camera.T_cam_world[:3, :3]


def points_in_view(cameras: Sequence[Camera], near: float, far: float, count: int, seed: int) -> Array:
    """Draw (count, 3) random points where the cameras' views overlap, at depths between near and far, world units.

    Each point lies on the ray of a random pixel of a random camera, uniform in 1 / depth: things get points in
    proportion to the pixels that they cover. It is kept if at least half as many cameras see it as the one most seen.
    """
    rng = np.random.default_rng(seed)
    kept = np.empty((0, 3))
    least = 0.0
    while len(kept) < count:
        n = max(2 * count, 1000)
        which = rng.integers(len(cameras), size=n)
        across = rng.uniform(size=(n, 2))
        depth = 1 / rng.uniform(1 / far, 1 / near, n)
        points = np.empty((n, 3))
        for index, camera in enumerate(cameras):
            mine = which == index
            points[mine] = points_at(camera, across[mine] * [camera.width, camera.height], depth[mine])
        seen = views_of(points, cameras, near * (1 - 1e-9), far * (1 + 1e-9))
        least = least or seen.max() / 2
        kept = np.concatenate([kept, points[seen >= least]])
    return kept[:count]


def is_random(cloud: Cloud) -> bool:
    """Whether a cloud fills its bounding box evenly, like the random clouds that other trainers write into a folder."""
    points = cloud.points.astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    cells = min(int((len(points) / DENSITY) ** (1 / 3)), 32)
    if cells < MIN_CELLS or not (high > low).all():
        return False
    at = np.minimum(((points - low) / (high - low) * cells).astype(int), cells - 1)
    return len(np.unique(at @ [cells * cells, cells, 1])) >= FILLED * cells**3
