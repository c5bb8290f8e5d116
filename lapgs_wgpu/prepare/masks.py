"""Masks of what moves as images: written for the user to look at, and read where the user brings some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from lapgs_wgpu.data.images import Size, check_image, decode, encode_png
from lapgs_wgpu.data.masks import WHITE, Mask, check_mask_size, find_masks

MASKS = "masks"  # folder of a capture


def write_masks(folder: Path, masks: Mapping[str, Mask]) -> None:
    """Write PNG images below a folder, white where something moves, under the images' names."""
    for name, mask in masks.items():
        path = folder / PurePosixPath(name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(mask.astype(np.uint8) * 255))


def read_masks(folder: Path, names: Sequence[str], size: Size) -> dict[str, Mask]:
    """Read the masks of images of (width, height), white where something moves, by the images' names.

    Every image needs one: NAME.png or NAME.jpg.png (COLMAP's way) below the folder. Raises InputError.
    """
    paths = find_masks(
        folder, names, "each image in images/ of a first run without --masks, with the same --fps, named as the image"
    )
    for path in paths.values():
        check_mask_size(path, size)
    return {name: read_mask(path) for name, path in paths.items()}


def read_mask(path: Path) -> Mask:
    """(h, w), white where something moves. Raises InputError."""
    check_image(path, whole=False)
    return decode(path)[..., 0] >= WHITE
