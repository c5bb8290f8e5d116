"""Read frames of videos. Each video is unpacked once into lossless images outside the capture, and read from there.

Frames depend on each other: decoding one in the middle of a clip takes seconds, since all frames from the last keyframe
on are decoded first (docs/notes/captures.md has the times), and a training reads frames in random order, again and
again.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path, PurePath
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import LANCZOS, ImageFile, Pixels, Size, encode_png, resize, size_text
from lapgs_wgpu.errors import InputError, pip_install
from lapgs_wgpu.io.atomic import move

# Flags of swscale: bicubic, accurate rounding, chroma interpolated along rows. Its default darkens by 1 or 2 levels.
EXACT_COLORS = 0x4 | 0x40000 | 0x2000
COMPRESSION = 1  # of PNG: the next levels take twice as long for a tenth of the bytes
LARGEST_FRAME = 8192 * 8192  # pixels; the decoder holds several frames
WIDEST = 4.0  # width by height of a pixel, or height by width; what a header states beyond it is no such ratio
WRITERS = min(8, os.cpu_count() or 1)  # threads that shrink and write the frames of the video that is being unpacked
INTERLACED = (
    "its frames are interlaced, each made of two half frames of different times, which blurs what moves into combs; "
    "deinterlace it first (ffmpeg -vf bwdif)"
)
_unpacking = Lock()  # one video at a time, with all processors, which bounds memory


class Video:
    """A video file whose packets were counted. frames: their number. size: (width, height) in pixels, upright."""

    def __init__(self, path: Path) -> None:
        """Read the header, the first frame, which says whether the camera was turned, and all packets: those that an
        edit list cuts off are no frames, though the header counts them. Raises InputError, also if PyAV is missing."""
        av = import_av(path)
        self.path = path
        first, self.frames = None, 0
        try:
            with av.open(str(path), metadata_errors="replace") as file:
                if not file.streams.video:
                    raise InputError(f"{path} has no video stream; give the camera's recording.")
                stream = file.streams.video[0]
                if stream.codec_context is None:
                    raise InputError(f"{path} is in a format that PyAV cannot decode; record or convert it to H.264.")
                self._check_header(stream)
                stream.codec_context.options = {"max_pixels": str(LARGEST_FRAME)}  # whatever the header states
                for packet in file.demux(stream):
                    first = first or next(iter(packet.decode()), None)
                    self.frames += packet.size > 0 and not packet.is_discard
        except (av.error.FFmpegError, OSError) as error:
            raise InputError(f"{path} is not a readable video ({error}); copy or record it again.") from None
        if first is None:
            raise InputError(f"{path} has {self.frames} frames that can be decoded; copy or record it again.")
        self._display = display(first)
        self.size = self._display.size((first.width, first.height))
        if first.interlaced_frame:
            print(f"{path}: {INTERLACED}", file=sys.stderr, flush=True)

    def _check_header(self, stream: Any) -> None:
        """Raises InputError for frames that are too many, too large, or not of square pixels."""
        what = f"{self.path} has frames of {stream.width}x{stream.height} pixels"
        if stream.width * stream.height > LARGEST_FRAME:
            raise InputError(f"{what}, and at most {LARGEST_FRAME:,} pixels a frame are allowed; shrink it.")
        if stream.frames > self.path.stat().st_size:
            raise InputError(
                f"{self.path} has {stream.frames} frames, it states, in {self.path.stat().st_size} bytes; copy it "
                "again."
            )
        aspect = pixel_aspect(stream)
        if abs(aspect - 1) > 0.01:
            raise InputError(
                f"{what}, each {aspect:.3g} times as wide as high; convert it to square pixels, which the one focal "
                "length of its camera is for."
            )

    def read(self, frame: int, size: Size) -> Pixels:
        """Return a frame, counted from 0, shrunk to (width, height): (H, W, 3) RGB. Thread-safe.

        The first call unpacks the whole video. Raises InputError.
        """
        folder = self._folder(size)
        if not folder.is_dir():
            with _unpacking:
                if not folder.is_dir():
                    self._unpack(folder, size)
        return ImageFile(folder / f"{frame:05d}.png", size).read(size)

    def _folder(self, size: Size) -> Path:
        """The folder for the frames of this size; size and date of the video are part of its name."""
        try:
            stat = self.path.stat()
        except OSError as error:
            raise InputError(f"{self.path} cannot be read any more ({error.strerror}); put it back.") from None
        path = self.path.resolve()
        state = f"{stat.st_size:x}-{stat.st_mtime_ns:x}" + (f"-{self._display}" if any(self._display) else "")
        return cache_folder() / "frames" / _place(path.parent) / f"{path.stem}-{size[0]}x{size[1]}-{state}"

    def _unpack(self, folder: Path, size: Size) -> None:
        """Write every frame as PNG into a new folder, atomically."""
        av = import_av(self.path)
        print(f"{self.path}: {self.frames} frames are unpacked once, into {folder}", file=sys.stderr, flush=True)
        unfinished = None
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            unfinished = Path(tempfile.mkdtemp(suffix=".partial", dir=folder.parent))
            written: deque[Future[None]] = deque()
            count = 0
            with (
                ThreadPoolExecutor(WRITERS, thread_name_prefix="unpack") as pool,
                av.open(str(self.path), metadata_errors="replace") as file,
            ):
                stream = file.streams.video[0]
                stream.thread_type = "AUTO"
                stream.codec_context.options = {"max_pixels": str(LARGEST_FRAME)}  # whatever the header states
                for frame in file.decode(stream):
                    image = frame.to_ndarray(format="rgb24", interpolation=EXACT_COLORS)
                    image = self._display.apply(image)
                    if image.shape[1::-1] != self.size:
                        raise InputError(
                            f"{self.path}: frame {count} has {size_text(image.shape[1::-1])} pixels, and the first has "
                            f"{size_text(self.size)}; convert it to one size."
                        )
                    if len(written) == 2 * WRITERS:  # the decoder is ahead of the writers: bound the frames in memory
                        written.popleft().result()
                    written.append(pool.submit(_write, image, size, unfinished / f"{count:05d}.png"))
                    count += 1
                for pending in written:
                    pending.result()
            if count != self.frames:
                raise InputError(f"{self.path} has {self.frames} frames, and {count} can be decoded; copy it again.")
            move(unfinished, folder)
        except av.error.FFmpegError as error:
            raise InputError(f"{self.path} cannot be decoded ({error}); copy or record it again.") from None
        except OSError as error:
            if not folder.is_dir():  # otherwise another process was faster
                raise InputError(
                    f"{folder} cannot be written ({error.strerror or error}); make room there, or set XDG_CACHE_HOME "
                    f"to a folder with room for about {self.frames * size[0] * size[1] * 1.5e-9:.1f} GB a video."
                ) from None
        finally:
            if unfinished is not None:
                shutil.rmtree(unfinished, ignore_errors=True)


class VideoFrame(NamedTuple):
    """A frame of a video. number: counted from 0."""

    video: Video
    number: int

    @property
    def size(self) -> Size:
        """(width, height) in pixels."""
        return self.video.size

    def __str__(self) -> str:
        return f"{self.video.path}, frame {self.number}"

    def read(self, size: Size) -> Pixels:
        """Return the frame, shrunk to (width, height): see `Video.read`. Raises InputError."""
        return self.video.read(self.number, size)


class Display(NamedTuple):
    """How the pixels of a film are shown: mirrored (left and right exchanged) first, then turned.

    turns: by 90 degrees counterclockwise, 0 to 3.
    """

    turns: int
    mirrored: bool

    def __str__(self) -> str:
        return f"turned-{self.turns}" + ("-mirrored" if self.mirrored else "")

    def size(self, coded: Size) -> Size:
        """(width, height) as shown."""
        return coded[::-1] if self.turns % 2 else coded

    def apply(self, image: NDArray[Any]) -> NDArray[Any]:
        """The image (H, W, ...) as shown."""
        if self.mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(np.rot90(image, self.turns))


def display(frame: Any) -> Display:
    """The display of a frame: of its matrix, whose rotation alone PyAV states, wrongly for mirrored ones."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return Display(round(frame.rotation / 90) % 4, False)
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5] / 65536  # x' = a x + c y, y' = b x + d y; y points down
    mirrored = bool(a * d - b * c < 0)
    if mirrored:  # the matrix times that of the mirror, which comes first
        a, b = -a, -b
    return Display(round(float(np.arctan2(-b, a)) / (np.pi / 2)) % 4, mirrored)


def cache_folder() -> Path:
    """The folder of caches: lapgs_wgpu in XDG_CACHE_HOME, else in ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lapgs_wgpu"


def _place(folder: PurePath) -> str:
    """The last two names of a folder; neither a drive nor a share among them, which would lead out of the cache."""
    return "-".join([part for part in folder.parts if part != folder.anchor][-2:])


def pixel_aspect(stream: Any) -> float:
    """Width by height of a pixel; 1 where the film states nothing, or nothing possible."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return aspect if 1 / WIDEST <= aspect <= WIDEST else 1.0


def _write(image: Pixels, size: Size, path: Path) -> None:
    image = resize(image, size, LANCZOS)  # the filter of the figures published for Neu3D
    path.write_bytes(encode_png(image, level=COMPRESSION))


def import_av(path: Path) -> Any:
    """The module PyAV. Raises InputError, which names the film, where it is not installed."""
    try:
        import av
    except ImportError:
        raise InputError(
            f"{path} needs PyAV to be decoded: {pip_install('prepare')}, or extract its frames into "
            f"{path.with_suffix('')}/images/*.png."
        ) from None
    return av
