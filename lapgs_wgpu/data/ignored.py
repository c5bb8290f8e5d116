"""Masks of training images: pixels that do not count in the training loss.

They are white in masks of a user's own, and black in those that a capture names itself (nerfstudio's `mask_path`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import NEAREST, Pixels, Size, decode, resize, shrink
from lapgs_wgpu.data.mask_files import WHITE, check_mask_size, find_mask
from lapgs_wgpu.data.undistort import Undistortion
from lapgs_wgpu.errors import InputError

LOOKED_AT = 8  # masks that are decoded when a capture is opened


def find_ignored(folder: Path, names: Sequence[str], splits: Sequence[str]) -> dict[str, Path]:
    """Find the mask of each training image, NAME.png or NAME.jpg.png.

    Args:
        folder: of the masks.
        names: of all images, below the folder of images.
        splits: of these images; those of "train" need a mask.

    Returns:
        By the names of the training images.

    Raises:
        InputError: no such folder, or a mask is missing.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; data.masks needs one with a PNG for each training image.")
    found: dict[str, Path] = {}
    missing = []
    for name in (name for name, split in zip(names, splits, strict=True) if split == "train"):
        path = find_mask(folder, name)
        if path is None:
            missing.append(name)
        else:
            found[name] = path
    if missing:
        raise InputError(
            f"{folder} lacks {len(missing)} of {len(missing) + len(found)} masks of training images, such as that of "
            f"{missing[0]}; name each mask as its image, or leave out data.masks."
        )
    return found


def check_ignored(masks: Mapping[str, Path], size: Size, *, black: bool) -> list[str]:
    """Check the proportions of masks of images of (width, height) `size`, and look at some of them.

    masks: by image; black: as in `read_ignored`. Warns if nothing is ignored in those looked at. Raises InputError for
    other proportions, or if everything is.
    """
    for path in masks.values():
        check_mask_size(path, size)
    looked_at = evenly(list(masks.values()), LOOKED_AT)
    levels = [decode(path)[..., :3].max(axis=2) for path in looked_at]
    ignored = [(level < WHITE) == black for level in levels]
    color = f"{'black (a level below' if black else 'white (a level of at least'} {WHITE} of 255)"
    if levels and not any(pixels.any() for pixels in ignored):
        lowest, highest = min(level.min() for level in levels), max(level.max() for level in levels)
        return [
            f"the masks leave out nothing: in {len(levels)} of {len(masks)} that were looked at, such as "
            f"{looked_at[0]}, no pixel is {color}; their levels are {lowest} to {highest}."
        ]
    if levels and all(pixels.all() for pixels in ignored):
        raise InputError(
            f"the masks leave out everything: in {len(levels)} of {len(masks)} that were looked at, such as "
            f"{looked_at[0]}, every pixel is {color}, which does not count in the training; invert them, or leave them "
            "out."
        )
    return []


def read_ignored(
    path: Path, undistortion: Undistortion | None, stored: Size, size: Size, *, black: bool
) -> NDArray[np.bool_]:
    """Decode the mask of an image of (width, height) `stored` that is undistorted and shrunk to `size`: (H, W).

    An output pixel is ignored if any of the mask's pixels that it covers is. black: whether black pixels are ignored,
    or white ones. Raises InputError.
    """
    level = resize(decode(path)[..., :3], stored, NEAREST).max(axis=2, keepdims=True)
    ignored: Pixels = np.repeat(np.where((level < WHITE) == black, 255, 0).astype(np.uint8), 3, axis=2)
    return shrink(ignored if undistortion is None else undistortion.apply(ignored), size)[..., 0] > 0
