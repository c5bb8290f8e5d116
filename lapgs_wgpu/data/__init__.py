"""Captures: readers that turn what lies on disk into views, and a scene of our own."""

from __future__ import annotations

from pathlib import Path

from lapgs_wgpu.data.dnerf import is_dnerf, load_dnerf
from lapgs_wgpu.data.views import Dataset, ImageCache, View, composite
from lapgs_wgpu.errors import InputError

__all__ = ["Dataset", "ImageCache", "View", "composite", "load_dataset"]


def load_dataset(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a capture, its format told by the files it holds (for now: D-NeRF).

    image_size: longer side in pixels, 1 or more, to which larger pictures are shrunk; None keeps all as they are.
    Raises InputError.
    """
    folder = Path(folder)
    if not folder.is_dir() or is_dnerf(folder):
        return load_dnerf(folder, image_size=image_size)
    scenes = sorted(child.name for child in folder.iterdir() if child.is_dir() and is_dnerf(child))
    inside = f"; it holds the scenes {', '.join(scenes[:8])}: name one of them" if scenes else ""
    expected = "transforms_train.json and transforms_test.json (D-NeRF)"
    raise InputError(f"{folder} is no scene in a known format: expected {expected}{inside}.")
