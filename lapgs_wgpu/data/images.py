"""Image files, PNG and JPEG: header checks, decoding, resampling, encoding.

imageio decodes and encodes. Pillow, on which imageio's plugin is built, does what imageio does not offer: read a header
without decoding the image, verify checksums, restrict the formats, decode a JPEG at a fraction of its size, resample.
"""

import math
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from lapgs_wgpu.data.evenly import some
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply_elements import LFS_POINTER

Pixels = NDArray[np.uint8]
Size = tuple[int, int]  # (width, height) in pixels

SUFFIXES = (".png", ".jpg", ".jpeg")
_FORMATS = ("PNG", "JPEG")  # no other decoder of Pillow gets a file
_ERRORS = (  # what Pillow raises; the last five for damage that it takes for valid data
    OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError,
    IndexError, KeyError, TypeError, struct.error, zlib.error,
)  # fmt: skip
_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "I;16", "I"}  # the last two: gray PNG of 16 bits
_OTHERS = re.compile(  # first bytes of other formats
    rb"(?P<WebP>.{8}WEBP)|(?P<HEIC>.{4}ftyp(hei|mif1|msf1))|(?P<AVIF>.{4}ftypavi)|(?P<TIFF>II\*\0|MM\0\*)|(?P<GIF>GIF8)"
    rb"|(?P<BMP>BM)|(?P<OpenEXR>\x76\x2f\x31\x01)|(?P<JPEG_XL>\xff\x0a|.{4}JXL )",
    re.DOTALL,
)
SIDEWAYS = 5  # orientations from this one on exchange width and height

THUMBNAIL = 320  # longer side, pixels: what is blurred or equal at this size is so for a training, too
BLURRED = 0.3  # relative to the sharpness of the images before and after
AROUND = 5  # number of images before, and after
EQUAL = 3  # levels of 255: the largest difference of a repeated image, above noise at this size

LANCZOS, NEAREST = Image.Resampling.LANCZOS, Image.Resampling.NEAREST


class ImageFile(NamedTuple):
    """An image file whose header was checked.

    size: (width, height) in pixels. orientation: as EXIF states it, 1 to 8; 1 is upright. deep: whether it has 16 bits
    per channel, of which the upper 8 are read. alpha: whether it states opacities. upright: whether `read` turns it as
    `orientation` says. source: where it comes from if not from a file of the capture, for errors.
    """

    path: Path
    size: Size
    orientation: int = 1
    deep: bool = False
    alpha: bool = False
    upright: bool = False
    source: str = ""

    def __str__(self) -> str:
        return self.source or str(self.path)

    def read(self, size: Size) -> Pixels:
        """Decode the image and shrink it to (width, height): see `decode`. Raises InputError."""
        image = decode(self.path)
        if self.upright:
            image = oriented(image, self.orientation)
        if image.shape[1::-1] != self.size:
            sizes = f"{size_text(image.shape[1::-1])} pixels now and was {size_text(self.size)} when it was opened"
            raise InputError(f"{self.path} is {sizes}; put the image back.")
        return shrink(image, size)

    @property
    def turned(self) -> "ImageFile":
        """The same file, read as its orientation says."""
        return self._replace(size=oriented_size(self.size, self.orientation), upright=True)


def oriented_size(size: Size, orientation: int) -> Size:
    """(width, height) as EXIF's orientation, 1 to 8, shows it."""
    return size[::-1] if orientation >= SIDEWAYS else size


def oriented(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An image (H, W, ...) as EXIF's orientation, 1 to 8, shows it."""
    if orientation >= SIDEWAYS:
        image = image.swapaxes(0, 1)
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(image[::rows, ::columns])


def check_image(path: Path, *, whole: bool = True) -> ImageFile:
    """Check the header of an image of 8 or 16 bits per channel. Raises InputError.

    whole: also read every byte (of a PNG, verify each checksum); no pixel is decoded.
    """
    with _decoding(path), Image.open(path, formats=_FORMATS) as file:
        size, mode = file.size, file.mode
        exif = file.format != "PNG" or "exif" in file.info  # else Pillow would decode a PNG to look for more
        orientation = file.getexif().get(ExifTags.Base.Orientation, 1) if exif else 1
        deep = file.format == "PNG" and "16" in str(file.tile[0][3])
        alpha = _has_alpha(file)
        if whole:
            file.verify()
    if mode not in _MODES:
        raise InputError(f"{path} has pixels of mode {mode}; save it as RGB or RGBA with 8 bits per channel.")
    return ImageFile(path, size, orientation if orientation in range(1, 9) else 1, deep, alpha)


def _has_alpha(file: Image.Image) -> bool:
    """Whether `decode` returns opacities."""
    return not file.mode.startswith("I") and ("A" in file.getbands() or "transparency" in file.info)


def _content(path: Path) -> str:
    """What a file that is neither PNG nor JPEG holds, and what to do, for errors."""
    with path.open("rb") as file:
        head = file.read(64)
    if not head:
        return "is empty (0 bytes); copy or render it again."
    if head.startswith(LFS_POINTER):
        return "is a pointer of Git LFS in place of the image; fetch it by git lfs pull."
    if other := _OTHERS.match(head):
        return f"holds an image in the format {other.lastgroup}, whatever its name; convert it to PNG or JPEG."
    return "is not a readable image (neither PNG nor JPEG); copy or render it again."


def decode(path: Path) -> Pixels:
    """Decode an image: (H, W, 4) straight RGBA, or (H, W, 3) RGB if it has no transparency. Raises InputError.

    Of 16 bits per channel, the upper 8 are kept.
    """
    with _decoding(path), open(path, "rb") as file:  # not the path: imageio would look into archives
        header = Image.open(file, formats=_FORMATS)
        if header.mode.startswith("I"):  # Pillow clips 16 bits of gray, and takes the upper 8 of RGB
            gray = (np.asarray(header) >> 8).astype(np.uint8)
            return np.repeat(gray[..., None], 3, axis=2)
        file.seek(0)
        return iio.imread(file, plugin="pillow", index=0, mode="RGBA" if _has_alpha(header) else "RGB")


def decode_gray(path: Path) -> NDArray[Any]:
    """Decode a gray PNG of 8 or 16 bits: (H, W) levels. Raises InputError."""
    with _decoding(path), Image.open(path, formats=("PNG",)) as file:
        if file.mode not in ("L", "I", "I;16", "I;16B"):
            raise ValueError(f"its pixels have the mode {file.mode}; it must be gray, of 8 or 16 bits")
        return np.asarray(file)


def gray_thumbnail(path: Path) -> NDArray[np.float32]:
    """Gray levels 0 to 255 of a small version of an image, its longer side at most THUMBNAIL. Raises InputError."""
    size = THUMBNAIL, THUMBNAIL
    with _decoding(path), Image.open(path, formats=_FORMATS) as file:
        file.draft("L", size)
        image = (file if file.mode[0] != "I" else Image.fromarray(decode(path))).convert("L")  # 16 bits of gray
        image.thumbnail(size, Image.Resampling.BOX)
        return np.asarray(image, dtype=np.float32)


def sharpness(gray: NDArray[np.float32]) -> float:
    """Variance of the Laplacian of a thumbnail (H, W); 0 where it has no inner pixel."""
    if min(gray.shape) < 3:
        return 0.0
    inner = gray[1:-1, 1:-1]
    return float((gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * inner).var())


def blurred(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether each image is much less sharp than those around it, by the sharpness of all in the order of time."""
    if len(values) < 2:
        return np.zeros(len(values), bool)
    near = (np.delete(values[max(i - AROUND, 0) : i + AROUND + 1], min(i, AROUND)) for i in range(len(values)))
    return values < BLURRED * np.array([np.median(around) for around in near])


def repeats(gray: NDArray[np.float32], before: NDArray[np.float32]) -> bool:
    """Whether a thumbnail shows the same as the one before."""
    return gray.shape == before.shape and bool(np.abs(gray - before).max() <= EQUAL)


def check_film(images: Sequence[Path]) -> list[str]:
    """Warn about images of one camera, in the order of time, that are blurred or repeated. Raises InputError."""
    if len(images) < 3:
        return []
    with ThreadPoolExecutor(4, thread_name_prefix="thumbnails") as pool:
        gray = list(pool.map(gray_thumbnail, images))
    soft = blurred(np.array([sharpness(each) for each in gray]))
    blurry = [path.name for path, bad in zip(images, soft, strict=True) if bad]
    same = [path.name for path, (before, now) in zip(images[1:], pairwise(gray), strict=True) if repeats(now, before)]
    found = (
        ("blurred", blurry, f"have less than {BLURRED:g} of their neighbours' sharpness"),
        ("repeated", same, f"differ by at most {EQUAL} of 255 levels from the one before: motion stands still"),
    )
    return [
        f"{word} images: {some(names)} ({len(names)} of {len(images)}) {reason}; leave them out, and what names them."
        for word, names, reason in found
        if names
    ]


@contextmanager
def _decoding(path: Path) -> Iterator[None]:
    try:
        yield
    except Image.UnidentifiedImageError:
        raise InputError(f"{path} {_content(path)}") from None
    except _ERRORS as error:
        raise InputError(f"{path} is not a readable image ({error}); copy or render it again.") from None


def encode_png(image: Pixels, *, level: int = 6) -> bytes:
    """Encode an image (H, W) gray, (H, W, 3) RGB or (H, W, 4) RGBA as PNG. level: of the compression, 0 to 9."""
    return iio.imwrite("<bytes>", image, extension=".png", plugin="pillow", is_batch=False, compress_level=level) or b""


def encode_jpeg(image: Pixels) -> bytes:
    """Encode an image (H, W, 3) RGB as JPEG of quality 80, for a page."""
    return iio.imwrite("<bytes>", image, extension=".jpg", plugin="pillow", is_batch=False, quality=80) or b""


def resize(image: Pixels, size: Size, resampling: Image.Resampling) -> Pixels:
    """Resample an image (H, W, C) to (width, height)."""
    # Pillow premultiplies RGBA around the filter: the color of transparent pixels does not bleed into edges.
    return image if image.shape[1::-1] == size else np.array(Image.fromarray(image).resize(size, resampling))


def shrink(image: Pixels, size: Size) -> Pixels:
    """Shrink an image (H, W, C) to (width, height): average whole pixels, else apply a Hamming filter."""
    # Averaging is exact if each new pixel covers whole old ones; otherwise it would shift details.
    whole = all(old % new == 0 for old, new in zip(image.shape[1::-1], size, strict=True))
    return resize(image, size, Image.Resampling.BOX if whole else Image.Resampling.HAMMING)


def shrunk_size(stored: Size, image_size: int | None) -> Size:
    """(width, height) whose longer side is at most image_size, in the proportions of `stored`."""
    longer = max(stored)
    if image_size is None or image_size >= longer:
        return stored
    width, height = (max(1, math.floor(side * image_size / longer + 0.5)) for side in stored)
    return width, height


def scales_to(size: Size, other: Size) -> bool:
    """Whether images of two sizes may be one that was resized, its sides rounded up or down."""
    return abs(size[0] * other[1] / other[0] - size[1]) <= 1.5


def size_text(size: Size) -> str:
    """A size as errors show it."""
    return f"{size[0]}x{size[1]}"
