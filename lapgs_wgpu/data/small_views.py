"""Views of a capture with small images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import shrink
from lapgs_wgpu.data.views import View
from lapgs_wgpu.splat.camera import Camera


def small_views(views: Sequence[View], size: int) -> list[View]:
    """The views with their longer side shrunk to `size` pixels, smaller ones as they are. Views that share a camera
    still share one, and each image is read once."""
    cameras: dict[int, Camera] = {}
    found = []
    for view in views:
        width, height = view.camera.width, view.camera.height
        scale = size / max(width, height)
        if scale >= 1:
            found.append(view)
            continue
        small = max(1, round(scale * width)), max(1, round(scale * height))
        camera = cameras.setdefault(id(view.camera), view.camera.resized(*small))
        ignored = None if view.ignored is None else partial(_shrunk_mask, view, small)
        pixels = cache(partial(_shrunk, view, small))
        found.append(dataclasses.replace(view, camera=camera, pixels=pixels, ignored=ignored))
    return found


def _shrunk(view: View, size: tuple[int, int]) -> NDArray[np.uint8]:
    return shrink(view.load(), size)


def _shrunk_mask(view: View, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A pixel is ignored where any of the pixels mixed into it is."""
    ignored = view.load_ignored()
    assert ignored is not None
    return shrink(np.repeat(np.where(ignored, 255, 0).astype(np.uint8)[..., None], 3, axis=2), size)[..., 0] > 0
