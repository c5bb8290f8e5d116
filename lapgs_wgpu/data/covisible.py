"""DyCheck's covisibility masks (Gao et al. 2022) of held-out pictures: white is what enough training pictures show.

docs/data.md says where they lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.lens import Array, Lens, straightened
from lapgs_wgpu.data.pictures import check_picture, check_proportions, decode, factor_folders
from lapgs_wgpu.errors import InputError

SPLITS = ("val", "val_intl")  # of DyCheck's own captures; of rigs whose cameras take turns to be trained on
WHITE = 255


def find_masks(covisible: Path, names: Sequence[str], factor: str) -> dict[str, Path]:
    """Id -> mask of all these test pictures, or of none: {}.

    They come from one folder of `covisible`: that of the pictures' factor, such as "2x", or, if it holds none of them,
    that of the smallest which does. Raises InputError where it holds some of them only.
    """
    folders = [scale / split for scale in (covisible / factor, *factor_folders(covisible)) for split in SPLITS]
    for folder in folders:
        masks = {name: folder / f"{name}.png" for name in names}
        missing = [path for path in masks.values() if not path.is_file()]
        if not missing:
            return masks
        if len(missing) < len(masks):
            raise InputError(
                f"{missing[0]} does not exist, but {len(masks) - len(missing)} of {len(masks)} test pictures have a "
                f"mask there; add it, or remove {covisible}."
            )
    return {}


def check_mask(path: Path, expected: tuple[int, int], camera: str) -> None:
    """InputError unless a file is a mask with the proportions of `expected` (width, height) and something to measure.

    camera: what the error calls where that size stands.
    """
    check_proportions(check_picture(path), expected, path, camera)
    if np.asarray(decode(path))[..., 0].max() < WHITE:
        raise InputError(
            f"{path} has no white pixel ({WHITE}), which leaves nothing to measure; make it again, or remove the masks "
            "of all test pictures."
        )


def read_mask(path: Path, lens: Lens, K: Array, stored: tuple[int, int], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which pixels of the picture that `read_straight` makes with the same arguments are measured: (H, W).

    The mask, of any size, is brought to `stored` by nearest neighbours. Where straightening and shrinking mix several
    pixels, all must be white. Raises InputError.
    """
    mask = decode(path).convert("RGB").resize(stored, Image.Resampling.NEAREST)
    return straightened(mask, lens, K, size)[..., 0] == WHITE
