"""Masks of what moves as images: written for the user to look at, and read where the user brings some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Size, decode, encode_png
from lapgs_wgpu.data.mask_files import WHITE, check_mask_size, find_mask
from lapgs_wgpu.errors import InputError

Mask = NDArray[np.bool_]
MASKS = "masks"  # folder of a capture


def write_masks(folder: Path, masks: Mapping[str, Mask]) -> None:
    """Write PNG images below a folder, white where something moves, under the images' names."""
    for name, mask in masks.items():
        path = folder / PurePosixPath(name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(mask.astype(np.uint8) * 255))


def check_folder(folder: Path) -> None:
    """Raises InputError where a folder of masks is none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; --masks needs one with a PNG for each image.")


def read_masks(folder: Path, names: Sequence[str], size: Size) -> dict[str, Mask]:
    """Read the masks of images of (width, height), white where something moves, by the images' names.

    Every image needs one: NAME.png or NAME.jpg.png (COLMAP's way) below the folder. Raises InputError.
    """
    check_folder(folder)
    found = {name: find_mask(folder, name) for name in names}
    missing = [name for name, path in found.items() if path is None]
    if missing:
        example = PurePosixPath(missing[0]).with_suffix(".png").name
        raise InputError(
            f"{folder} lacks {len(missing)} of {len(names)} masks, such as {example}; name each mask as its image in "
            "images/ of a first run without --masks, with the same --fps."
        )
    masks = {}
    for name, path in found.items():
        assert path is not None
        check_mask_size(path, size)
        masks[name] = decode(path)[..., 0] >= WHITE
    return masks
