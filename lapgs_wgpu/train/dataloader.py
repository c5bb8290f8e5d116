"""Training views in the order in which they are trained on, with their pictures on the device."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import ImageCache, View, composite
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, Background
from lapgs_wgpu.train.truth_cache import TruthCache, without

AHEAD = 8  # pictures that are decoded before they are needed
DECODERS = min(4, os.cpu_count() or 1)  # threads that decode them


class ImageLoader:
    """Training views in random order without replacement, epoch after epoch.

    generator: where the order, and random backgrounds, are drawn from. cache_gb: bound on what is kept on the device
    and on what is kept in memory; together where the device's memory is the host's.
    """

    def __init__(
        self,
        views: tuple[View, ...],
        background: Background,
        cache_gb: float,
        generator: torch.Generator,
        device: Device,
    ) -> None:
        self._color = None if background == "random" else torch.full((3,), BACKGROUND_LEVELS[background])
        self._views = views if self._color is None else tuple(_on_background(v, self._color.numpy()) for v in views)
        bound = int(cache_gb * 1e9)
        in_memory = bound
        if device.info.kind in ("cpu", "integrated"):
            # A picture on the device is in the same memory a second time: the host keeps only what is under way.
            largest = max(4 * view.camera.width * view.camera.height for view in views)
            in_memory = min((AHEAD + 1) * largest, bound // 2)
            bound -= in_memory
        self._cache = ImageCache(in_memory, workers=DECODERS)
        self._truths = TruthCache(device, bound)
        self._generator = generator
        self.order: list[int] = []  # the views that are still to come in this epoch, by number

    def close(self) -> None:
        """End the decoding, and forget the pictures on the device: what follows a training needs the memory."""
        self._cache.close()
        self._truths.clear()

    def choose(self) -> tuple[View, Tensor]:
        """The next view, and the background (3,) that its picture lies on."""
        if not self.order:
            self.order = torch.randperm(len(self._views), generator=self._generator).tolist()
        view = self._views[self.order.pop(0)]
        coming = (self._views[i] for i in self.order[:AHEAD])
        self._cache.prefetch(each for each in coming if each not in self._truths)
        return view, torch.rand(3, generator=self._generator) if self._color is None else self._color

    def on_device(self, view: View) -> DeviceArray:
        """The picture of a view that `choose` gave, for `render_loss`."""
        return self._truths.get(view, lambda: without(self._cache.get(view), view.load_ignored()))


def _on_background(view: View, color: NDArray[np.float32]) -> View:
    """The view without transparency, so that it is laid on its background once and not at every step."""
    return dataclasses.replace(view, pixels=lambda: composite(view.load(), color))
