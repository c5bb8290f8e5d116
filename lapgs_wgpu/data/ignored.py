"""Masks of a user's own: white pixels of training images do not count in the training loss."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import NEAREST, Size, decode, resize, shrink
from lapgs_wgpu.data.mask_files import WHITE, check_mask_size, find_mask
from lapgs_wgpu.data.undistort import Undistortion
from lapgs_wgpu.errors import InputError


def find_ignored(folder: Path, names: Sequence[str], splits: Sequence[str], size: Size) -> dict[str, Path]:
    """Find the mask of each training image, NAME.png or NAME.jpg.png, and check its proportions.

    Args:
        folder: of the masks.
        names: of all images, below the folder of images.
        splits: of these images; those of "train" need a mask.
        size: (width, height) of the images.

    Returns:
        By the names of the training images.

    Raises:
        InputError: no such folder, a mask is missing, or it has other proportions than the images.
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
    for path in found.values():
        check_mask_size(path, size)
    return found


def read_ignored(path: Path, undistortion: Undistortion | None, stored: Size, size: Size) -> NDArray[np.bool_]:
    """Decode the mask of an image of (width, height) `stored` that is undistorted and shrunk to `size`: (H, W).

    A pixel is ignored where any of the pixels mixed into it is. Raises InputError.
    """
    white = np.where(resize(decode(path)[..., :3], stored, NEAREST) >= WHITE, 255, 0).astype(np.uint8)
    return shrink(white if undistortion is None else undistortion.apply(white), size)[..., 0] > 0
