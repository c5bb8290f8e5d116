"""The images that a training compares its renderings with: in which order, decoded, composited and kept in one place.

The host prepares an image once: it composites it over the background and marks the pixels that the losses leave out.
The image then stays on the device; the host reads it back where it needs it.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.images import Size, shrunk_size
from lapgs_wgpu.data.views import View, composite, small_views
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, DataConfig

DECODERS = min(4, os.cpu_count() or 1)  # threads that decode images before they are needed
AHEAD = 8  # images that are decoded before they are needed
Mark = tuple[Tensor, list[int]]  # where draws stand: the generator's state, and the views that are left of an epoch


class GroundTruth:
    """The ground truth of training views. The most recently used images stay on the device.

    backgrounds: of each view (3,) in [0, 1], behind its rendering and its transparent pixels. max_bytes: of the images
    that are kept on the device, 4 bytes a pixel. A larger image is returned, but not kept. halved: whether images have
    half their size.
    """

    def __init__(self, device: Device, backgrounds: Mapping[View, Tensor], max_bytes: int) -> None:
        self._device, self.backgrounds, self._max_bytes = device, backgrounds, max_bytes
        self._kept: dict[View, DeviceArray] = {}  # that used last at the end
        self._coming: dict[View, Future[NDArray[np.uint8]]] = {}
        self._threads = ThreadPoolExecutor(DECODERS, thread_name_prefix="decode")
        self.halved = False

    def halve(self, halved: bool) -> None:
        """Give images of half the size from now on, or whole ones."""
        self.halved = halved
        self._forget()

    def camera(self, camera: Camera) -> Camera:
        """A camera at the size that its images have now."""
        return camera.resized(*_half(camera)) if self.halved else camera

    @property
    def used_bytes(self) -> int:
        """Bytes that are kept on the device at present."""
        return sum(array.buffer.nbytes for array in self._kept.values())

    def prefetch(self, views: Iterable[View]) -> None:
        """Decode the images that are needed next, in the background; `on_device` raises what goes wrong there."""
        self._coming = {
            view: self._coming.get(view) or self._threads.submit(self._pixels, view)
            for view in views
            if view not in self._kept
        }

    def on_device(self, view: View) -> DeviceArray:
        """The image of a view, as `render_loss` takes it (`upload_rgba`). Raises InputError where it cannot be read."""
        array = self._kept.pop(view, None)
        if array is None:
            coming = self._coming.pop(view, None)
            pixels = coming.result() if coming else self._pixels(view)
            array = upload_rgba(self._device, pixels)
        if array.buffer.nbytes <= self._max_bytes:
            while self.used_bytes + array.buffer.nbytes > self._max_bytes:
                del self._kept[next(iter(self._kept))]
            self._kept[view] = array
        return array

    def on_host(self, view: View) -> "HostImage":
        """The image of a view on the background. Raises InputError where it cannot be read."""
        return host_image(self.on_device(view).read())

    def _pixels(self, view: View) -> NDArray[np.uint8]:
        shown = small_views([view], max(_half(view.camera)))[0] if self.halved else view
        return marked_pixels(shown, self.backgrounds[view])

    def close(self) -> None:
        """End the decoding, and forget all images: what follows a training needs the memory."""
        self._threads.shutdown(cancel_futures=True)
        self._forget()

    def _forget(self) -> None:
        self._coming.clear()
        self._kept.clear()


def _half(camera: Camera) -> Size:
    stored = camera.width, camera.height
    return shrunk_size(stored, max(stored) // 2)


def backgrounds_of(views: Sequence[View], config: DataConfig) -> dict[View, Tensor]:
    """The background colors (3,) of training views: the same for all, or random ones."""
    if not config.vary_background:
        return dict.fromkeys(views, torch.full((3,), BACKGROUND_LEVELS[config.background]))
    colors = np.random.default_rng(0).random((len(views), 3), np.float32)
    return dict(zip(views, torch.from_numpy(colors), strict=True))


class Draws:
    """What the steps of a training draw: views in random order without replacement, epoch after epoch.

    generator: of whatever else they draw. truth: the images. left: the numbers of the views that are still to come in
    this epoch.
    """

    def __init__(self, views: Sequence[View], generator: torch.Generator, truth: GroundTruth) -> None:
        self._views, self.generator, self.truth = views, generator, truth
        self.left: list[int] = []

    def next(self) -> View:
        """The next view, whose image, and those after it in this epoch, are decoded meanwhile."""
        if not self.left:
            self.left = torch.randperm(len(self._views), generator=self.generator).tolist()
        self.truth.prefetch(self._views[number] for number in self.left[: AHEAD + 1])
        return self._views[self.left.pop(0)]

    def mark(self) -> Mark:
        """Where they stand, for `go_back`."""
        return self.generator.get_state(), list(self.left)

    def go_back(self, mark: Mark) -> None:
        """Draw again what was drawn since."""
        random, left = mark
        self.generator.set_state(random)
        self.left = list(left)


class HostImage(NamedTuple):
    """An image (H, W, 3) of float32 in [0, 1], and where losses leave it out, (H, W, 1) bool."""

    image: Tensor
    left_out: Tensor


def host_image(texels: NDArray[np.uint32]) -> HostImage:
    """What `upload_rgba` brought to the device, (H, W)."""
    rgba = texels.view(np.uint8).reshape(*texels.shape, 4)
    image = rgba[..., :3].astype(np.float32) / 255
    return HostImage(torch.from_numpy(image), torch.from_numpy(rgba[..., 3:] == 0))


def marked_pixels(view: View, color: Tensor) -> NDArray[np.uint8]:
    """Return the image of a view over a background color (3,): (H, W, 3) RGB; or, where the losses leave pixels out,
    (H, W, 4), in which these have that color and alpha 0. Raises InputError where image or mask cannot be read."""
    pixels, ignored = view.load(), view.load_ignored()
    if ignored is None:
        return composite(pixels, color.numpy())
    rgba = _rgba(pixels)
    rgba[ignored] = 0
    return np.dstack([composite(rgba, color.numpy()), np.where(ignored, 0, 255).astype(np.uint8)])


def upload_rgba(device: Device, pixels: NDArray[np.uint8]) -> DeviceArray:
    """(H, W) uint32 on the device, red in the lowest byte, of (H, W, 3) RGB or (H, W, 4) RGBA in 8 bits."""
    return DeviceArray.upload(device, "truth", _rgba(pixels).view(np.uint32)[..., 0])


def _rgba(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A new array (H, W, 4), opaque where the pixels (H, W, 3 or 4) have no alpha."""
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., : pixels.shape[2]] = pixels
    return rgba
