"""Masks of images: files found by the images' names, checked when a capture is opened, decoded view by view.

Masks of training images say which pixels the loss ignores. They are white in masks of a user's own, and black in those
that a capture names itself (nerfstudio's `mask_path`). Masks of test images say which pixels the masked metrics
measure: DyCheck's covisibility masks (Gao et al. 2022), white where enough training images show a point.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import NEAREST, Pixels, Size, check_image, decode, resize, shrink, size_text
from lapgs_wgpu.data.lens import Undistortion
from lapgs_wgpu.errors import InputError

Mask = NDArray[np.bool_]

WHITE = 128  # level from which on a pixel is set
MEASURED = 255  # level of a pixel that the masked metrics measure: what mixes with others does not count
CHECKED = 8  # masks that are decoded when a capture is opened


def check_mask_folder(folder: Path, what: str) -> None:
    """Check that a folder of masks exists. what: that needs a mask, for errors. Raises InputError."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; masks need one with a PNG for {what}.")


def find_masks(folder: Path, names: Iterable[str], what: str) -> dict[str, Path]:
    """Find the masks of images by their names: NAME.png or NAME.jpg.png (COLMAP's way) below a folder.

    what: the images and how masks are named, for errors. Raises InputError: no such folder, or a mask is missing.
    """
    check_mask_folder(folder, what)
    masks = {}
    missing = []
    for name in names:
        paths = folder / PurePosixPath(name).with_suffix(".png"), folder / f"{name}.png"
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            missing.append(name)
        else:
            masks[name] = path
    if missing:
        raise InputError(
            f"{folder} lacks {len(missing)} of {len(missing) + len(masks)} masks, such as that of {missing[0]}; add a "
            f"PNG for {what}."
        )
    return masks


def check_mask_size(path: Path, size: Size) -> None:
    """Check that a mask has the proportions of images of (width, height). Raises InputError."""
    stored = check_image(path, whole=False).size
    if abs(stored[0] * size[1] / size[0] - stored[1]) > 1.5:
        raise InputError(
            f"{path} is {size_text(stored)} pixels, and the images are {size_text(size)}, which has other "
            "proportions; make the masks from the images."
        )


def check_ignored(masks: Mapping[str, Path], size: Size, *, black: bool) -> list[str]:
    """Check the proportions of training masks for images of (width, height) `size`, and decode some of them.

    masks: by image. black: as in `read_ignored`. Warns if nothing is ignored in those decoded. Raises InputError for
    other proportions, or if everything is.
    """
    for path in masks.values():
        check_mask_size(path, size)
    checked = evenly(list(masks.values()), CHECKED)
    levels = [_levels(decode(path)) for path in checked]
    ignored = [(level < WHITE) == black for level in levels]
    color = f"{'black (a level below' if black else 'white (a level of at least'} {WHITE} of 255)"
    if not levels:
        return []
    lowest, highest = min(level.min() for level in levels), max(level.max() for level in levels)
    if not any(pixels.any() for pixels in ignored):
        return [
            f"the masks leave out nothing: in {len(levels)} of {len(masks)} that were looked at, such as "
            f"{checked[0]}, no pixel is {color}; their levels are {lowest} to {highest}."
        ]
    if all(pixels.all() for pixels in ignored):
        raise InputError(
            f"the masks leave out everything: in {len(levels)} of {len(masks)} that were looked at, such as "
            f"{checked[0]}, every pixel is {color}, which does not count in the training; their levels are {lowest} to "
            f"{highest}: write them as 0 and 255, invert them, or leave them out."
        )
    return []


def read_ignored(path: Path, undistortion: Undistortion | None, stored: Size, size: Size, *, black: bool) -> Mask:
    """Decode a training mask (H, W) of an image of (width, height) `stored` that is undistorted and shrunk to `size`.

    An output pixel is ignored if any of the mask's pixels that it covers is. black: whether black pixels are ignored,
    or white ones. Raises InputError.
    """
    ignored = (_levels(decode(path)) < WHITE) == black
    pixels = resize(as_pixels(ignored), stored, NEAREST)
    return shrink(pixels if undistortion is None else undistortion.apply(pixels), size)[..., 0] > 0


def _levels(mask: Pixels) -> NDArray[np.uint8]:
    """The levels (H, W) of a mask: of its alpha if its color is the same everywhere; 0 and 1 mean 0 and 255."""
    level = mask[..., :3].max(axis=2)
    if mask.shape[2] == 4 and level.min() == level.max():
        level = mask[..., 3] if mask[..., 3].min() < 255 else level
    return level * np.uint8(255) if level.max() == 1 else level


def as_pixels(mask: Mask) -> Pixels:
    """(H, W, 3) white where a mask (H, W) is set, black elsewhere."""
    return np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def find_covisible(folders: Sequence[Path], names: Sequence[str]) -> dict[str, Path]:
    """Find the masks NAME.png of all these test images in the first folder that holds any; {} if none does.

    Raises InputError if a folder holds only some of them.
    """
    for folder in folders:
        masks = {name: folder / f"{name}.png" for name in names}
        missing = [path for path in masks.values() if not path.is_file()]
        if not missing:
            return masks
        if len(missing) < len(masks):
            raise InputError(
                f"{missing[0]} does not exist, but {len(masks) - len(missing)} of {len(masks)} test images have a "
                f"mask there; add it, or remove {folder}."
            )
    return {}


def check_measured(path: Path) -> None:
    """Check that a test mask has a white pixel. Raises InputError."""
    if decode(path)[..., 0].max() < MEASURED:
        raise InputError(
            f"{path} has no white pixel ({MEASURED}), which leaves nothing to measure; make it again, or remove the "
            "masks of all test images."
        )


def read_measured(path: Path, undistortion: Undistortion | None, stored: Size, size: Size) -> Mask:
    """Decode the test mask of an image of (width, height) `stored` that is undistorted and shrunk to `size`: (H, W).

    The mask is first resized to `stored` by nearest neighbours. Where undistorting and shrinking mix pixels, all must
    be white. Raises InputError.
    """
    mask = resize(decode(path)[..., :3], stored, NEAREST)
    return shrink(mask if undistortion is None else undistortion.apply(mask), size)[..., 0] == MEASURED
