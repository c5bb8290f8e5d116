"""Picture files: what is checked when a capture is opened, and how they are decoded and shrunk."""

from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.errors import InputError

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
PICTURE_FORMATS = ("PNG", "JPEG")  # no other of Pillow's decoders is handed a file
PICTURE_ERRORS = (  # what Pillow raises; the last five where it takes damage for what the format says
    OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError,
    IndexError, KeyError, TypeError, struct.error, zlib.error,
)  # fmt: skip
EIGHT_BIT_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA"}


def decode(path: Path) -> Image.Image:
    """An 8-bit picture as RGBA or, where it has no transparency, RGB. Raises InputError."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as file:
            transparent = "A" in file.getbands() or "transparency" in file.info
            return file.convert("RGBA" if transparent else "RGB")
    except PICTURE_ERRORS as error:
        raise InputError(f"{path} cannot be decoded as a picture ({error}); copy or render it again.") from None


def shrink(picture: Image.Image, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The picture at (width, height): (H, W, 3) RGB or (H, W, 4) straight RGBA, uint8."""
    if picture.size != size:
        # Averaging is exact where whole pixels fall together; elsewhere it would shift details: take a smooth filter.
        whole = all(old % new == 0 for old, new in zip(picture.size, size, strict=True))
        # Pillow premultiplies RGBA around the filter: the colour of transparent pixels does not bleed into edges.
        picture = picture.resize(size, Image.Resampling.BOX if whole else Image.Resampling.HAMMING)
    return np.array(picture)


def read_picture(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Decode an 8-bit picture, shrunk to (width, height).

    Returns (H, W, 4) straight RGBA or, where it has no transparency, (H, W, 3) RGB. Raises InputError.
    """
    return shrink(decode(path), size)


def check_picture(path: Path, *, whole: bool = True) -> tuple[int, int]:
    """(width, height) of a picture without decoding it; whole: every byte is read (in a PNG each chunk's checksum)."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as file:
            size, mode = file.size, file.mode
            if whole:
                file.verify()
    except PICTURE_ERRORS as error:
        reason = "neither PNG nor JPEG" if isinstance(error, Image.UnidentifiedImageError) else error
        raise InputError(f"{path} is not a readable picture ({reason}); copy or render it again.") from None
    if mode not in EIGHT_BIT_MODES:
        raise InputError(f"{path} has pixels of mode {mode}; save it as RGB or RGBA with 8 bits a channel.")
    return size


def check_pictures(paths: list[Path], *, whole: bool = True) -> tuple[int, int]:
    """(width, height) that all of these pictures have. Raises InputError."""
    first, *others = paths
    stored = check_picture(first, whole=whole)
    for path in others:
        size = check_picture(path, whole=whole)
        if size != stored:
            raise InputError(
                f"{path} is {text(size)} pixels and {first} is {text(stored)}; all pictures must have one size."
            )
    return stored


def shrunk(stored: tuple[int, int], image_size: int | None) -> tuple[int, int]:
    """(width, height) whose longer side is at most image_size, in the proportions of `stored`."""
    longer = max(stored)
    if image_size is None or image_size >= longer:
        return stored
    width, height = (max(1, math.floor(side * image_size / longer + 0.5)) for side in stored)
    return width, height


def factor_folders(folder: Path) -> list[Path]:
    """The folders 1x, 2x, ... in a folder, by number: nerfies' layout of the same pictures at 1 / N of their size."""
    found = [child for child in folder.glob("*x") if re.fullmatch(r"[1-9]\d{0,3}x", child.name)]
    return sorted(found, key=lambda child: int(child.name[:-1]))


def check_proportions(stored: tuple[int, int], expected: tuple[int, int], picture: str | Path, camera: str) -> None:
    """InputError unless pictures of size `stored` are those that a camera of size `expected` took, scaled.

    picture, camera: what the error calls the two.
    """
    # Whoever shrank the pictures may have rounded each side up or down.
    if abs(stored[0] * expected[1] / expected[0] - stored[1]) > 1.5:
        raise InputError(
            f"{picture} is {text(stored)} pixels but {camera} says {text(expected)}, which has other proportions; "
            "they do not belong together."
        )


def text(size: tuple[int, int]) -> str:
    """A size as errors show it."""
    return f"{size[0]}x{size[1]}"
