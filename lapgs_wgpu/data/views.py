"""What every reader of captures produces: views with lazily decoded 8-bit pixels, and a byte-bounded cache for them."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.data.objects import ObjectTruth
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera


@dataclass(frozen=True, eq=False)
class View:
    """One picture of a capture: where and when it was taken, and how to get its pixels.

    name: unique within its dataset and safe as a file name, such as "train_007".
    camera: its size is that of the pixels.
    time: in [0, 1] over the clip.
    source: what errors call the pixels: a file, or a video and its frame.
    pixels: decodes them, each time anew and from any thread: (height, width, 3) RGB or (height, width, 4) straight
        (not premultiplied) RGBA, uint8. Raises InputError where they cannot be read.
    mask: decodes which pixels of a held-out view the masked metrics measure, such as DyCheck's covisibility masks (what
        enough training cameras saw): (height, width) bool. Raises InputError, too.
    objects: the truth about moving objects in a held-out view of a generated scene (data/objects.py).
    """

    name: str
    camera: Camera
    time: float
    source: str
    pixels: Callable[[], NDArray[np.uint8]]
    mask: Callable[[], NDArray[np.bool_]] | None = None
    objects: tuple[ObjectTruth, ...] = ()

    def load(self) -> NDArray[np.uint8]:
        """Decode: (H, W, 3) RGB or (H, W, 4) straight RGBA, uint8, read-only. Raises InputError."""
        image = self.pixels()
        size = (self.camera.height, self.camera.width)
        if image.dtype != np.uint8 or image.shape not in {(*size, 3), (*size, 4)}:
            raise InputError(
                f"{self.source}: expected {size[1]}x{size[0]} pixels of 3 or 4 channels in 8 bit, "
                f"got an array of {image.shape} {image.dtype}; was the file replaced while it was in use?"
            )
        image.setflags(write=False)
        return image

    def load_mask(self) -> NDArray[np.bool_] | None:
        """Which pixels the masked metrics measure: (H, W) bool, at least one; None without mask. Raises InputError."""
        if self.mask is None:
            return None
        mask = self.mask()
        size = (self.camera.height, self.camera.width)
        if mask.dtype != np.bool_ or mask.shape != size or not mask.any():
            raise InputError(
                f"{self.source}: expected a mask of {size[1]}x{size[0]} pixels, at least one of them set, got an array "
                f"of {mask.shape} {mask.dtype} with {np.count_nonzero(mask)} set; make the mask again, or remove it."
            )
        return mask


@dataclass(frozen=True, eq=False)
class Dataset:
    """A capture: the views to train on and the views held out for testing, all of which share one time axis.

    cloud: points that it brings, where Gaussians start. depths: nearest and furthest of what the cameras see, world
    units, where the capture says so. placement: how it was moved, None where its coordinates are those of its files.
    warnings: what looks wrong but does not stop a training, a sentence each. time_source: field and file of the times,
    for errors.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    cloud: Cloud | None = None
    depths: tuple[float, float] | None = None
    normalization: Normalization | None = None
    warnings: tuple[str, ...] = ()
    time_source: str = "time"

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The training cameras, those that stay where they are once."""
        return tuple({id(view.camera): view.camera for view in self.train}.values())

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean, world units; 0 where all coincide."""
        centres = np.stack([view.camera.position for view in self.train])
        return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with the cameras, the times and the sizes of the files."""
        digest = hashlib.sha256()
        for view in (*self.train, *self.test):
            camera, file = view.camera, Path(view.source)
            size = file.stat().st_size if file.is_file() else 0
            digest.update(f"{view.name} {view.time!r} {camera.width} {camera.height} {size}".encode())
            digest.update(camera.K.tobytes() + camera.T_cam_world.tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def up(self) -> NDArray[np.float64]:
        """(3,) of unit length: what is up in the pictures, on average over the training cameras."""
        mean = -np.mean([view.camera.T_cam_world[1, :3] for view in self.train], axis=0)
        length = np.linalg.norm(mean)
        return mean / length if length > 1e-3 else -self.train[0].camera.T_cam_world[1, :3]

    @cached_property
    def focus(self) -> NDArray[np.float64]:
        """(3,) the point that the training cameras look at (`focus_of`)."""
        return focus_of([view.camera for view in self.train])

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """(T,) the distinct training times, ascending."""
        return np.unique([view.time for view in self.train])


def focus_of(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """(3,) the point nearest to the lines of sight of all cameras; where these are parallel, and say little, one extent
    (1.1 times the largest distance of a camera from their mean) in front of them."""
    centres = np.stack([camera.position for camera in cameras])
    ahead = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    faint = 1e-3 * len(centres) * np.eye(3)
    extent = 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    guess = centres.mean(axis=0) + (extent or 1.0) * ahead.mean(axis=0)
    right_side = np.einsum("nij,nj->i", across, centres) + faint @ guess
    return np.linalg.solve(across.sum(axis=0) + faint, right_side)


def composite(image: NDArray[np.uint8], background: ArrayLike) -> NDArray[np.uint8]:
    """Lay straight RGBA over a background color, rounded to the nearest 8-bit value (truncating would darken by 0.5).

    image: (H, W, 4) uint8, or (H, W, 3), which has no transparency and is returned as it is.
    background: (3,) in [0, 1]. Returns (H, W, 3) uint8.
    """
    if image.shape[2] == 3:
        return image
    below = np.asarray(background, dtype=np.float32)
    if below.shape != (3,) or not ((below >= 0) & (below <= 1)).all():
        raise ValueError(f"background must be three numbers in [0, 1], got {below}")
    alpha = image[..., 3:].astype(np.float32)
    mixed = image[..., :3] * alpha + (255.0 - alpha) * (255.0 * below)
    return np.floor(mixed / 255.0 + 0.5).astype(np.uint8)


class ImageCache:
    """Decoded views, the most recently used first to stay, within a bound in bytes. Safe to use from many threads.

    max_bytes: bound on the pixels that are kept; an image larger than this is returned and not kept.
    used_bytes: of the pixels kept at present.
    workers: threads that decode what `prefetch` names. Each can hold one picture beyond the bound while it decodes.
    """

    def __init__(self, max_bytes: int, *, workers: int = 1) -> None:
        self.max_bytes = max_bytes
        self._lock = Lock()
        self._entries: OrderedDict[View, Future[NDArray[np.uint8]]] = OrderedDict()
        self.used_bytes = 0
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="decode")

    def get(self, view: View) -> NDArray[np.uint8]:
        """The view's pixels as `View.load` gives them. A view asked for by several threads is decoded once."""
        with self._lock:
            entry = self._entries.get(view)
            if entry is not None:
                self._entries.move_to_end(view)
            else:
                mine = self._entries[view] = Future()
        if entry is not None:
            return entry.result()
        try:
            image = view.load()
        except BaseException as error:
            with self._lock:  # so that a later call tries again
                del self._entries[view]
            mine.set_exception(error)
            raise
        mine.set_result(image)
        with self._lock:
            self.used_bytes += image.nbytes
            self._evict()
        return image

    def prefetch(self, views: Iterable[View]) -> None:
        """Decode views ahead of need on the worker threads. What fails here is reported by `get`."""
        for view in views:
            self._pool.submit(self.get, view)

    def close(self) -> None:
        """Drop what is queued and wait for the decodes under way."""
        self._pool.shutdown(cancel_futures=True)

    def _evict(self) -> None:
        for view, entry in list(self._entries.items()):
            if self.used_bytes <= self.max_bytes:
                return
            if entry.done():
                self.used_bytes -= entry.result().nbytes
                del self._entries[view]
