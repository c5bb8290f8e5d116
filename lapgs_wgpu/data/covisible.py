"""Covisibility masks of DyCheck (Gao et al. 2022) for test images: white is what enough training images show.

docs/data.md describes the files.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import NEAREST, Size, decode, resize, shrink
from lapgs_wgpu.data.undistort import Undistortion
from lapgs_wgpu.errors import InputError

SPLITS = ("val", "val_intl")  # of DyCheck's captures; of rigs that alternate the training camera
WHITE = 255


def find_covisible(covisible: Path, names: Sequence[str], factor: str) -> dict[str, Path]:
    """Find the masks of all these test images, by id; {} if there is none.

    They come from one folder of `covisible`: that of the images' factor, such as "2x", or, if it holds none of them,
    that of the smallest factor which does. Raises InputError if a folder holds only some of them.
    """
    folders = [scale / split for scale in (covisible / factor, *factor_folders(covisible)) for split in SPLITS]
    for folder in folders:
        masks = {name: folder / f"{name}.png" for name in names}
        missing = [path for path in masks.values() if not path.is_file()]
        if not missing:
            return masks
        if len(missing) < len(masks):
            raise InputError(
                f"{missing[0]} does not exist, but {len(masks) - len(missing)} of {len(masks)} test images have a "
                f"mask there; add it, or remove {covisible}."
            )
    return {}


def factor_folders(folder: Path) -> list[Path]:
    """The folders 1x, 2x, ... in a folder, by number: in nerfies' layout, the same images at 1 / N of their size."""
    found = [child for child in folder.glob("*x") if re.fullmatch(r"[1-9]\d{0,3}x", child.name)]
    return sorted(found, key=lambda child: int(child.name[:-1]))


def check_mask(path: Path) -> None:
    """Check that a mask has a white pixel. Raises InputError."""
    if decode(path)[..., 0].max() < WHITE:
        raise InputError(
            f"{path} has no white pixel ({WHITE}), which leaves nothing to measure; make it again, or remove the masks "
            "of all test images."
        )


def read_mask(path: Path, undistortion: Undistortion | None, stored: Size, size: Size) -> NDArray[np.bool_]:
    """Decode the mask of an image of (width, height) `stored` that is undistorted and shrunk to `size`: (H, W).

    The mask is first resized to `stored` by nearest neighbours. Where undistorting and shrinking mix pixels, all must
    be white. Raises InputError.
    """
    mask = resize(decode(path)[..., :3], stored, NEAREST)
    return shrink(mask if undistortion is None else undistortion.apply(mask), size)[..., 0] == WHITE
