"""The cloud of points that a capture brings: where Gaussians start. It is checked against the cameras first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.poses import Placement
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply_points import read_points
from lapgs_wgpu.splat.camera import Camera

Array = NDArray[np.float64]

# A triangulated point was seen by cameras. Where most are not, cloud and cameras have different coordinates.
LEAST_SEEN = 0.5
LEAST_SPREAD = 1e-3  # of the cloud, in distances of the cameras from it: a smaller one is a speck in every picture
PROBES = 64  # cameras that suffice to ask which points are seen


class Cloud(NamedTuple):
    """points: (N, 3) world units. colours: (N, 3) RGB in [0, 1]. Both float32."""

    points: NDArray[np.float32]
    colours: NDArray[np.float32]

    def at_most(self, count: int, seed: int) -> Cloud:
        """All of it, or `count` points drawn at random where it has more, in their order."""
        if len(self.points) <= count:
            return self
        chosen = np.sort(np.random.default_rng(seed).choice(len(self.points), count, replace=False))
        return Cloud(self.points[chosen], self.colours[chosen])

    def moved(self, placement: Placement) -> Cloud:
        return Cloud(placement.points(self.points.astype(np.float64)).astype(np.float32), self.colours)


def find_cloud(folder: Path, patterns: Sequence[str]) -> Path | None:
    """The first file that one of the patterns finds, the last of each pattern's by name."""
    for pattern in patterns:
        found = sorted(folder.glob(pattern))
        if found:
            return found[-1]
    return None


def read_cloud(path: Path) -> Cloud:
    """The points of a .npy or a .ply file, mid-grey where it says no colours. Raises InputError."""
    colours = None
    if path.suffix == ".npy":
        points = read_npy(path)
    else:
        points, colours = read_points(path)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"{path} must hold at least one point of 3 numbers, an array of (N, 3), got {points.shape}.")
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is named
        points = points.astype(np.float32)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path} holds NaN or infinite coordinates in {len(bad)} of {len(points)} points, first in point {bad[0]}; "
            "remove them."
        )
    return Cloud(points, np.full_like(points, 0.5) if colours is None else colours)


def read_npy(path: Path) -> NDArray[np.floating]:
    """An array of numbers. Raises InputError."""
    try:
        # Mapped, so that a declared shape takes no memory before it is compared with the file's size.
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        array = np.array(mapped) if isinstance(mapped, np.ndarray) else None
    except Exception as error:  # NumPy hands a damaged header to Python's own parser, and passes its errors on
        reason = str(error)[:200]
        raise InputError(f"{path} cannot be read as a NumPy array ({reason}); copy or make it again.") from None
    if array is None or array.dtype.kind not in "fiu":
        what = "an archive" if array is None else array.dtype
        raise InputError(f"{path} must hold an array of numbers, got {what}.")
    return array


def check_cloud(cloud: Cloud, cameras: Sequence[Camera], path: Path) -> None:
    """InputError unless cloud and cameras, in the same coordinates, look like parts of one capture."""
    points = cloud.points.astype(np.float64)
    centres = np.stack([camera.position for camera in cameras])
    middle = np.median(points, axis=0)
    spread = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90))
    distance = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    seen = float((views_of(points, cameras) > 0).mean())
    numbers = f"the cloud has a radius of {spread:.3g}, and the cameras stand {distance:.3g} away from it"
    if seen < LEAST_SEEN:
        raise InputError(
            f"{path}: the training cameras see {100 * seen:.0f} % of its points (at least {100 * LEAST_SEEN:.0f} % are "
            f"expected): {numbers}; it is in other coordinates than the cameras, so bring it to theirs or remove it."
        )
    if len(points) > 1 and spread < LEAST_SPREAD * distance:
        raise InputError(
            f"{path} is a speck: {numbers}; it has another scale than the cameras, so bring it to theirs or remove it."
        )


def evenly_chosen(cameras: Sequence[Camera]) -> list[Camera]:
    """All cameras, or PROBES of them."""
    return [cameras[i] for i in np.unique(np.linspace(0, len(cameras) - 1, PROBES).round().astype(int))]


def views_of(points: Array, cameras: Sequence[Camera], near: float = 0.0, far: float = np.inf) -> NDArray[np.int64]:
    """(N,) how many of the cameras (of PROBES evenly chosen ones, if there are more) see each point (N, 3), at a depth
    between near and far."""
    seen = np.zeros(len(points), dtype=np.int64)
    for camera in evenly_chosen(cameras):
        depths, inside = in_view(points, camera)
        seen += inside & (depths >= near) & (depths <= far)
    return seen


def in_view(points: NDArray[np.floating], camera: Camera) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Depths (N,) of points (N, 3), NaN behind the camera, and which of them lie in its picture."""
    local = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    depths = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    pixels = (local @ camera.K.T)[:, :2] / depths[:, None]
    within = (pixels >= 0) & (pixels < [camera.width, camera.height])
    return depths, within[:, 0] & within[:, 1]


def points_in_view(cameras: Sequence[Camera], near: float, far: float, count: int, seed: int) -> Array:
    """(count, 3) random points where the cameras' views overlap, between the depths near and far, world units.

    Each lies on the ray of a random pixel of a random camera, uniform in 1 / depth, so that near and far things get
    about as many points as they cover pixels. Kept are those that are seen by at least half as many cameras as the
    points that are seen by most.
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
            pixels = np.column_stack([across[mine] * [camera.width, camera.height], np.ones(mine.sum())])
            local = np.linalg.solve(camera.K, pixels.T).T * depth[mine, None]
            points[mine] = (local - camera.T_cam_world[:3, 3]) @ camera.T_cam_world[:3, :3]
        seen = views_of(points, cameras, near * (1 - 1e-9), far * (1 + 1e-9))
        least = least or seen.max() / 2
        kept = np.concatenate([kept, points[seen >= least]])
    return kept[:count]
