"""Masks of images: files found by the images' names, checked when a capture is opened, decoded view by view.

Masks of training images say which pixels the loss ignores. They are white in masks of a user's own, and black in those
that a capture names itself (nerfstudio's `mask_path`). Masks of test images say which pixels the masked metrics
measure: DyCheck's covisibility masks (Gao et al. 2022), white where enough training images show a point.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import NEAREST, Pixels, Size, check_image, decode, resize, shrink, size_text
from lapgs_wgpu.data.lens import Undistortion
from lapgs_wgpu.errors import InputError

Mask = NDArray[np.bool_]
MaskKind = Literal["white", "black", "measured"]  # white or black pixels are ignored in training; white ones measured
MASKED = {"white": "train", "black": "train", "measured": "test"}  # the split whose masks are of this kind

WHITE = 128  # level from which on a pixel is set
MEASURED = 255  # level of a pixel that the masked metrics measure: what mixes with others does not count
MOSTLY = 127  # level of a shrunk mask, above which most of the pixels mixed there are set
CHECKED = 8  # masks that are decoded when a capture is opened


def check_mask_folder(folder: Path, what: str) -> None:
    """Check that a folder of masks exists. what: that needs a mask, for errors. Raises InputError."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; masks need one with a PNG for {what}.")


def find_masks(folder: Path, names: Iterable[str], what: str) -> dict[str, Path]:
    """Find the masks of all images by their names: NAME.png or NAME.jpg.png (COLMAP's way) below a folder.

    what: the images and how masks are named, for errors. Raises InputError: no such folder, or a mask is missing.
    """
    check_mask_folder(folder, what)
    masks, missing = _found(folder, names)
    if missing:
        count = f"{len(missing)} of {len(missing) + len(masks)}"
        raise InputError(f"{folder} lacks {count} masks, such as that of {missing[0]}; add a PNG for {what}.")
    return masks


def find_covisible(folders: Sequence[Path], names: Sequence[str]) -> dict[str, Path]:
    """Find the masks of all these test images in the first folder that holds any; {} if none does.

    Raises InputError if a folder holds only some of them.
    """
    for folder in folders:
        masks, missing = _found(folder, names)
        if masks and missing:
            raise InputError(
                f"{folder / missing[0]}.png does not exist, but {len(masks)} of {len(names)} test images have a mask "
                f"there; add it, or remove {folder}."
            )
        if masks:
            return masks
    return {}


def _found(folder: Path, names: Iterable[str]) -> tuple[dict[str, Path], list[str]]:
    """The masks below a folder by image, and the images without. Names may differ as in `CaptureFiles.find`, and lack
    the folder where all images lie in one."""
    files, paths = CaptureFiles(folder), {name: PurePosixPath(name) for name in names}
    one = len({path.parent for path in paths.values()}) == 1
    found = {}
    for name, path in paths.items():
        masks = [PurePosixPath(f"{path}.png"), path.with_suffix(".png")]
        masks += [PurePosixPath(mask.name) for mask in masks if one]
        found[name] = next((file for mask in masks if (file := files.find(str(mask)))), None)
    return {name: folder / file for name, file in found.items() if file}, [name for name in found if not found[name]]


def check_mask_size(path: Path, size: Size) -> None:
    """Check that a mask has the proportions of images of (width, height). Raises InputError."""
    stored = check_image(path, whole=False).size
    if abs(stored[0] * size[1] / size[0] - stored[1]) > 1.5:
        raise InputError(
            f"{path} is {size_text(stored)} pixels, and the images are {size_text(size)}, which has other "
            "proportions; make the masks from the images."
        )


def check_masks(masks: Mapping[str, Path], size: Size, kind: MaskKind, *, movers: bool = False) -> list[str]:
    """Check the proportions of masks for images of (width, height) `size`, and decode some of those of training images.

    masks: by image. movers: whether they say what moves, white. Returns a warning if these take out nothing. Raises
    InputError for other proportions, or if they take out everything.
    """
    for path in masks.values():
        check_mask_size(path, size)
    if kind == "measured":
        for path in masks.values():
            if _levels(decode(path)).max() < MEASURED:
                raise InputError(
                    f"{path} has no white pixel ({MEASURED}), which leaves nothing to measure; make it again, or "
                    "remove the masks of all test images."
                )
        return []
    checked = evenly(list(masks.values()), CHECKED)
    levels = [_levels(decode(path)) for path in checked]
    shares = [_taken_out(level, kind).mean() for level in levels]
    if not shares or (max(shares) > 0 and min(shares) < 1):
        return []
    color = f"{'black (a level below' if kind == 'black' else 'white (a level of at least'} {WHITE} of 255)"
    looked_at = (
        f"in {len(levels)} of {len(masks)} that were looked at, such as {checked[0]}, {{}} pixel is {color}; their "
        f"levels are {min(level.min() for level in levels)} to {max(level.max() for level in levels)}"
    )
    what = "moves by the masks" if movers else "is left out by the masks"
    if max(shares) == 0:
        return [f"nothing {what}: {looked_at.format('no')}."]
    raise InputError(
        f"everything {what}: {looked_at.format('every')}: write them as 0 and 255, invert them, or leave them out."
    )


def read_mask(
    path: Path, kind: MaskKind, undistortion: Undistortion | None, stored: Size, size: Size, above: int = 0
) -> Mask:
    """Decode the mask (H, W) of an image of (width, height) `stored` that is undistorted and shrunk to `size`.

    The mask is first resized to `stored` by nearest neighbours. A pixel in which several mix is ignored if any of them
    is, and measured if all of them are; `above` as in `MOSTLY`. Raises InputError.
    """
    pixels = resize(as_pixels(_taken_out(_levels(decode(path)), kind)), stored, NEAREST)
    out = shrink(pixels if undistortion is None else undistortion.apply(pixels), size)[..., 0] > above
    return ~out if kind == "measured" else out


def _taken_out(levels: NDArray[np.uint8], kind: MaskKind) -> Mask:
    """The pixels (H, W) that a mask of these levels takes out of training or measures."""
    return levels < MEASURED if kind == "measured" else (levels < WHITE) == (kind == "black")


def _levels(mask: Pixels) -> NDArray[np.uint8]:
    """The levels (H, W) of a mask: of its alpha if its color is the same everywhere; 0 and 1 mean 0 and 255."""
    level = mask[..., :3].max(axis=2)
    if mask.shape[2] == 4 and level.min() == level.max():
        level = mask[..., 3] if mask[..., 3].min() < 255 else level
    return level * np.uint8(255) if level.max() == 1 else level


def as_pixels(mask: Mask) -> Pixels:
    """(H, W, 3) white where a mask (H, W) is set, black elsewhere."""
    return np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
