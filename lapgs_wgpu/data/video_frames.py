"""Films of still cameras. Each is unpacked once into lossless images outside the capture, and read from there, since
decoding a frame in the middle of a clip takes seconds (docs/notes/captures.md).
"""

import os
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.images import (
    LANCZOS,
    ImageFile,
    Pixels,
    Size,
    encode_png,
    oriented,
    oriented_size,
    resize,
    shrunk_size,
    size_text,
)
from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.io.atomic import new_folder

# Flags of swscale: bicubic, accurate rounding, chroma interpolated along rows. Its default darkens by 1 or 2 levels.
EXACT_COLORS = 0x4 | 0x40000 | 0x2000
LARGEST_FRAME = 8192 * 8192  # pixels; the decoder holds several frames
TURNED = (1, 8, 3, 6), (2, 5, 4, 7)  # EXIF's orientations, by quarter turns counterclockwise; after mirroring
_ATTACHED_PICTURE = 0x400  # libavformat's flag of a cover image
WIDEST = 4.0  # width by height of a pixel, or height by width; what a header states beyond it is no such ratio
WRITERS = min(8, os.cpu_count() or 1)  # threads that shrink and write the frames of the video that is being unpacked
INTERLACED = (
    "its frames are interlaced, each made of two half frames of different times, which blurs what moves into combs; "
    "deinterlace it first (ffmpeg -vf bwdif)"
)


def unpacked(path: Path, image_size: int | None) -> list[ImageFile]:
    """Return the frames of a film, upright and with their longer side at most `image_size`; unpack them the first time.
    Frames that an edit list cuts off are none. Raises InputError, also if PyAV is missing."""
    with opened_film(path) as (file, stream):
        if abs(pixel_aspect(stream) - 1) > 0.01:
            raise InputError(
                f"{path} has frames of {stream.width}x{stream.height} pixels, each {pixel_aspect(stream):.3g} times as "
                "wide as high; convert it to square pixels, which the one focal length of its camera is for."
            )
        first = next(file.decode(stream), None)
    if first is None:
        raise InputError(f"{path} has no frame that can be decoded; copy or record it again.")
    if first.interlaced_frame:
        print(f"{path}: {INTERLACED}", file=sys.stderr, flush=True)
    turned = orientation(first)
    size = oriented_size((first.width, first.height), turned)
    wanted = shrunk_size(size, image_size)
    folder = frames_folder(path, wanted)
    if not folder.is_dir():
        _unpack(path, folder, turned, size, wanted)
    return [ImageFile(file, wanted, source=f"{path}, frame {i}") for i, file in enumerate(sorted(folder.glob("*.png")))]


def frames_folder(path: Path, size: Size) -> Path:
    """The folder of the cache for a film's frames of this (width, height). Its name tells the film, its size and date,
    and the last two folders above the film; no drive or share, since joining one would lead out of the cache."""
    stat, path = path.stat(), path.resolve()
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lapgs_wgpu"
    name = f"{path.stem}-{size[0]}x{size[1]}-{stat.st_size:x}-{stat.st_mtime_ns:x}"
    return caches / "frames" / "-".join(path.parts[1:-1][-2:]) / name


def _unpack(path: Path, folder: Path, turned: int, size: Size, wanted: Size) -> None:
    """Write every frame, of (width, height) `size`, as PNG of the wanted size into a new folder. Raises InputError."""
    print(f"{path}: its frames are unpacked once, into {folder}", file=sys.stderr, flush=True)
    written, declared = list[Future[None]](), 0
    with (
        new_folder(folder, "make room there, or set XDG_CACHE_HOME to another folder") as unfinished,
        ThreadPoolExecutor(WRITERS, thread_name_prefix="unpack") as pool,
        opened_film(path) as (file, stream),
    ):
        for packet in file.demux(stream):
            declared += packet.size > 0 and not packet.is_discard
            for frame in packet.decode():
                image = oriented(frame.to_ndarray(format="rgb24", interpolation=EXACT_COLORS), turned)
                if image.shape[1::-1] != size:
                    sizes = f"{size_text(image.shape[1::-1])} pixels, and the first {size_text(size)}"
                    raise InputError(f"{path}: frame {len(written)} has {sizes}; convert it to one size.")
                if len(written) >= 2 * WRITERS:  # the decoder is ahead: bound the frames in memory
                    written[-2 * WRITERS].result()
                written.append(pool.submit(_write, image, wanted, unfinished / f"{len(written):05d}.png"))
        for pending in written:
            pending.result()
        if len(written) != declared:
            raise InputError(f"{path} has {declared} frames, and {len(written)} can be decoded; copy it again.")


@contextmanager
def opened_film(path: Path) -> Iterator[tuple[Any, Any]]:
    """PyAV's file and the film among its streams: the largest one that is no cover picture. Raises InputError for what
    cannot be decoded, and for frames that are too large."""
    av = import_av(path)
    try:
        with av.open(str(path), metadata_errors="replace") as file:
            films = [each for each in file.streams.video if not int(each.disposition) & _ATTACHED_PICTURE]
            decoded = [each for each in films if each.codec_context is not None]
            if not decoded:
                raise InputError(
                    f"{path} has {len(films)} video streams, and PyAV can decode none; record or convert it to H.264."
                )
            stream = max(decoded, key=lambda each: (each.width or 0) * (each.height or 0))
            if not 1 <= stream.width * stream.height <= LARGEST_FRAME:
                raise InputError(
                    f"{path} states frames of {stream.width}x{stream.height} pixels; 1 to {LARGEST_FRAME:,} are read."
                )
            stream.thread_type = "AUTO"
            stream.codec_context.options = {"max_pixels": str(LARGEST_FRAME)}  # whatever the header states
            yield file, stream
    except av.error.FFmpegError as error:
        raise InputError(f"{path} cannot be decoded as a film ({error}); copy or record it again.") from None


def orientation(frame: Any) -> int:
    """EXIF's orientation of a frame: of its matrix, whose rotation alone PyAV states, wrongly for mirrored ones."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return TURNED[False][round(frame.rotation / 90) % 4]
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5] / 65536  # x' = a x + c y, y' = b x + d y; y points down
    mirrored = bool(a * d - b * c < 0)
    if mirrored:  # the matrix times that of the mirror, which comes first
        a, b = -a, -b
    return TURNED[mirrored][round(float(np.arctan2(-b, a)) / (np.pi / 2)) % 4]


def pixel_aspect(stream: Any) -> float:
    """Width by height of a pixel; 1 where the film states nothing, or nothing possible."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return aspect if 1 / WIDEST <= aspect <= WIDEST else 1.0


def _write(image: Pixels, size: Size, path: Path) -> None:
    image = resize(image, size, LANCZOS)  # the filter of the figures published for Neu3D
    path.write_bytes(encode_png(image, level=1))  # the next levels take twice as long for a tenth of the bytes


def import_av(path: Path) -> Any:
    """The module PyAV. Raises InputError, which names the film, where it is not installed."""
    need = f"{path} needs PyAV to be decoded, where there are no {path.with_suffix('')}/images/*.png of its frames"
    return optional_module("av", need, "prepare")
