"""Files of masks, one for each image, under the images' names."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from lapgs_wgpu.data.images import Size, check_image, size_text
from lapgs_wgpu.errors import InputError

WHITE = 128  # level from which on a pixel is set


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of an image, NAME.png or NAME.jpg.png (COLMAP's way) below a folder; None if there is none."""
    both = (folder / PurePosixPath(name).with_suffix(".png"), folder / f"{name}.png")
    return next((path for path in both if path.is_file()), None)


def check_mask_size(path: Path, size: Size) -> None:
    """Check that a mask has the proportions of images of (width, height). Raises InputError."""
    stored = check_image(path, whole=False).size
    if abs(stored[0] * size[1] / size[0] - stored[1]) > 1.5:
        raise InputError(
            f"{path} is {size_text(stored)} pixels, and the images are {size_text(size)}, which has other "
            "proportions; make the masks from the images."
        )
