"""Datasets: views with lazily decoded 8-bit images."""

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.focus import directions, focus_of, spread
from lapgs_wgpu.data.images import Size, shrink, shrunk_size
from lapgs_wgpu.data.masks import MOSTLY, as_pixels
from lapgs_wgpu.data.normalize import BOX, Normalization
from lapgs_wgpu.data.timestamps import time_step
from lapgs_wgpu.splat.camera import Camera

AROUND = 6  # cameras that tell what moves between them
ONE_SIDED = 0.8  # length of the mean direction to the cameras, from which on they stand on one side
GOLDEN_SECTION = (5**0.5 - 1) / 2


@dataclass(frozen=True, eq=False)
class View:
    """One image of a capture: camera, time, and access to its pixels, which may be decoded in any thread.

    name: unique within its dataset and safe as a file name, such as "train_007".
    camera: its size is that of the pixels.
    time: in [0, 1] over the clip.
    source: description of the image for errors: a file, or a video and its frame.
    load: decodes the image: (height, width, 3) RGB or (height, width, 4) straight (not premultiplied) RGBA, uint8.
        Raises InputError.
    ignored: decodes the pixels of a training view that the loss leaves out: (height, width) bool. Raises InputError.
    moving: decodes the pixels of what moves: (height, width) bool. Raises InputError.
    """

    name: str
    camera: Camera
    time: float
    source: str
    load: Callable[[], NDArray[np.uint8]]
    ignored: Callable[[], NDArray[np.bool_]] | None = None
    moving: Callable[[], NDArray[np.bool_]] | None = None

    def load_ignored(self) -> NDArray[np.bool_] | None:
        """Decode the pixels that the training loss leaves out: (H, W) bool; None for none. Raises InputError."""
        return None if self.ignored is None else self.ignored()


@dataclass(frozen=True, eq=False)
class Dataset:
    """A capture: training views and test views, which share one time axis.

    val: validation views, to choose settings by; none in most formats.
    cloud: point cloud for the initial Gaussians. depths: nearest and furthest depth, world units, if stated or derived.
    scale: world units per unit of length of the capture (HyperNeRF: after its scene.json), 1 if coordinates were kept.
    normalization: transform from the files' coordinates, None if they were kept. warnings: problems that do not prevent
    a training, one sentence each. time_source: field and file of the times, for errors.
    own_footage: poses were estimated from the images. summary: how the capture was understood, in one line.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    val: tuple[View, ...] = ()
    cloud: Cloud | None = None
    depths: tuple[float, float] | None = None
    normalization: Normalization | None = None
    scale: float = 1.0
    warnings: tuple[str, ...] = ()
    time_source: str = "time"
    own_footage: bool = False
    summary: str = ""

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The distinct training cameras."""
        return tuple(dict.fromkeys(view.camera for view in self.train))

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean, world units; BOX if it is 0."""
        return 1.1 * spread([view.camera for view in self.train]) or BOX

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that depend on cameras, times and file sizes."""
        digest = hashlib.sha256()
        for view in (*self.train, *self.test):
            camera, file = view.camera, Path(view.source)
            size = file.stat().st_size if file.is_file() else 0
            digest.update(f"{view.name} {view.time!r} {camera.width} {camera.height} {size}".encode())
            digest.update(camera.K.tobytes() + camera.T_cam_world.tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit vector: the up direction of the images, averaged over the training cameras."""
        mean = -np.mean([view.camera.T_cam_world[1, :3] for view in self.train], axis=0)
        length = np.linalg.norm(mean)
        return mean / length if length > 1e-3 else -self.train[0].camera.T_cam_world[1, :3]

    @cached_property
    def focus(self) -> NDArray[np.float64]:
        """(3,) the point that the training cameras look at (`focus_of`)."""
        return focus_of(self.cameras, origin=True)

    @cached_property
    def still_cameras(self) -> bool:
        """Whether cameras stand still: each shows several training images."""
        return len(self.train) >= 2 * len(self.cameras)

    @property
    def is_rig(self) -> bool:
        """Whether several cameras stand still: each keeps its own colors."""
        return len(self.cameras) > 1 and self.still_cameras

    @property
    def is_film(self) -> bool:
        """Whether one camera moves and shows each time once."""
        return len(self.train) == len(self.cameras) == len(self.times)

    @cached_property
    def is_surrounded(self) -> bool:
        """Whether still cameras stand all around what they look at, AROUND of them or more at each time."""
        if not self.is_rig or len(self.train) < AROUND * len(self.times):
            return False
        return bool(np.linalg.norm(directions(self.cameras, self.focus).mean(axis=0)) < ONE_SIDED)

    @cached_property
    def time_count(self) -> int:
        """The number of times; of a few still cameras, which may not be in step, the most images of one of them."""
        most = max(Counter(view.camera for view in self.train).values())
        return most if len(self.cameras) <= most else len(self.times)

    @property
    def time_gap(self) -> float:
        """The usual distance from one time to the next."""
        return time_step(self.times) if self.time_count == len(self.times) else 1 / (self.time_count - 1)

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """(T,) the distinct training times, ascending."""
        return np.unique([view.time for view in self.train])


def spread_views(views: Sequence[View], most: int) -> list[View]:
    """At most `most` of the views, in the order of their times, spread over the clip and over the cameras.

    Of each equal share of the views, in the order of times and names, one is taken, at a place that moves on from share
    to share by the golden section: in step with it, no period of the cameras is met again and again.
    """
    ordered = sorted(views, key=lambda view: (view.time, view.name))
    count = min(len(ordered), most)
    return [ordered[int((i + i * GOLDEN_SECTION % 1) * len(ordered) / count)] for i in range(count)]


def small_views(views: Sequence[View], size: int) -> list[View]:
    """Return the views with their longer side shrunk to `size` pixels, smaller ones as they are.

    Views that share a camera still share one, and each image is read once.
    """
    cameras: dict[Camera, Camera] = {}

    def shrunk(view: View) -> View:
        stored = view.camera.width, view.camera.height
        small = shrunk_size(stored, size)
        if small == stored:
            return view
        return dataclasses.replace(
            view,
            camera=cameras.setdefault(view.camera, view.camera.resized(*small)),
            load=cache(lambda: shrink(view.load(), small)),
            ignored=None if view.ignored is None else partial(_shrunk_mask, view.ignored, small),
            moving=None if view.moving is None else cache(partial(_shrunk_mask, view.moving, small, MOSTLY)),
        )

    return [shrunk(view) for view in views]


def _shrunk_mask(mask: Callable[[], NDArray[np.bool_]], size: Size, above: int = 0) -> NDArray[np.bool_]:
    """Shrink a mask (H, W): a pixel is set where the share that is of the pixels mixed into it is above this / 255."""
    return shrink(as_pixels(mask()), size)[..., 0] > above


def composite(image: NDArray[np.uint8], background: ArrayLike) -> NDArray[np.uint8]:
    """Composite straight RGBA over a background color, rounded to the nearest 8-bit value.

    image: (H, W, 4) uint8, or (H, W, 3), which is returned unchanged.
    background: (3,) in [0, 1]. Returns (H, W, 3) uint8.
    """
    if image.shape[2] == 3:
        return image
    below = np.asarray(background, dtype=np.float32)
    alpha = image[..., 3:].astype(np.float32)
    mixed = image[..., :3] * alpha + (255.0 - alpha) * (255.0 * below)
    return np.floor(mixed / 255.0 + 0.5).astype(np.uint8)
