"""Masks of images: files found by the images' names, checked when a capture is opened, decoded view by view.

They say which pixels of training images the loss ignores, white in masks of a user's own and black in those that a
capture names itself (nerfstudio's `mask_path`); or what moves, white.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.images import NEAREST, Pixels, Size, check_image, decode, resize, scales_to, shrink, size_text
from lapgs_wgpu.data.lens import Undistortion
from lapgs_wgpu.errors import InputError

Mask = NDArray[np.bool_]
MaskKind = Literal["white", "black"]  # pixels that are set

WHITE = 128  # level from which on a pixel is set
MOSTLY = 127  # level of a shrunk mask, above which most of the pixels mixed there are set
CHECKED = 8  # masks that are decoded when a capture is opened


def find_masks(folder: Path, names: Iterable[str], what: str) -> dict[str, Path]:
    """Find the masks of all images by their names: NAME.png or NAME.jpg.png (COLMAP's way) below a folder. Names may
    differ as in `CaptureFiles.find`, and lack the folder where all images lie in one.

    what: the images and how masks are named, for errors. Raises InputError: no such folder, or a mask is missing.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; masks need one with a PNG for {what}.")
    files, paths = CaptureFiles(folder), {name: PurePosixPath(name) for name in names}
    one = len({path.parent for path in paths.values()}) == 1
    found = {}
    for name, path in paths.items():
        masks = [PurePosixPath(f"{path}.png"), path.with_suffix(".png")]
        masks += [PurePosixPath(mask.name) for mask in masks if one]
        if file := next((file for mask in masks if (file := files.find(str(mask)))), None):
            found[name] = folder / file
    if missing := [name for name in paths if name not in found]:
        count = f"{len(missing)} of {len(paths)}"
        raise InputError(f"{folder} lacks {count} masks, such as that of {missing[0]}; add a PNG for {what}.")
    return found


def check_mask_size(path: Path, size: Size) -> None:
    """Check that a mask has the proportions of images of (width, height). Raises InputError."""
    stored = check_image(path, whole=False).size
    if not scales_to(stored, size):
        sizes = f"{size_text(stored)} pixels, and the images are {size_text(size)}, of other proportions"
        raise InputError(f"{path} is {sizes}; make the masks from the images.")


def check_masks(masks: Sequence[Path], size: Size, kind: MaskKind, what: str) -> list[str]:
    """Check the proportions of masks for images of (width, height) `size`, and decode some of them.

    what: they say of the pixels that they set, such as "moves". Returns a warning if they set no pixel of those that
    are decoded. Raises InputError for other proportions, or if they set all of these.
    """
    for path in masks:
        check_mask_size(path, size)
    if not masks:
        return []
    checked = evenly(masks, CHECKED)
    levels = [_levels(path) for path in checked]
    shares = [_is_set(each, kind).mean() for each in levels]
    told = f"{what} by the masks: in {len(checked)} of {len(masks)} that were looked at, such as {checked[0]},"
    lowest, highest = min(each.min() for each in levels), max(each.max() for each in levels)
    side = "below" if kind == "black" else "at least"
    color = f"pixel is {kind} ({side} {WHITE}, and their levels are {lowest} to {highest})"
    if max(shares) == 0:
        return [f"nothing {told} no {color}."]
    if min(shares) == 1:
        raise InputError(f"everything {told} every {color}; write them as 0 and 255, invert them, or leave them out.")
    return []


def read_mask(path: Path, kind: MaskKind, undistortion: Undistortion, size: Size, above: int = 0) -> Mask:
    """Decode the mask (H, W) of an image that is undistorted and shrunk to (width, height).

    It is first resized to the lens's size by nearest neighbours. A pixel in which several mix is set if any of them is;
    `above` as in `MOSTLY`. Raises InputError.
    """
    pixels = resize(as_pixels(decode_mask(path, kind)), undistortion.lens.size, NEAREST)
    return shrink(undistortion.apply(pixels), size)[..., 0] > above


def decode_mask(path: Path, kind: MaskKind = "white") -> Mask:
    """The pixels (H, W) that a mask sets. Raises InputError."""
    return _is_set(_levels(path), kind)


def _is_set(levels: NDArray[np.uint8], kind: MaskKind) -> Mask:
    return (levels < WHITE) == (kind == "black")


def _levels(path: Path) -> NDArray[np.uint8]:
    """The levels (H, W) of a mask: of its alpha if its color is the same everywhere; 0 and 1 mean 0 and 255."""
    mask = decode(path)
    level = mask[..., :3].max(axis=2)
    if mask.shape[2] == 4 and level.min() == level.max() and mask[..., 3].min() < 255:
        level = mask[..., 3]
    return level * np.uint8(255) if level.max() == 1 else level


def as_pixels(mask: Mask) -> Pixels:
    """(H, W, 3) white where a mask (H, W) is set, black elsewhere."""
    return np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
