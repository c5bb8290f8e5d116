"""Videos as pictures: each is unpacked once into lossless pictures outside the capture, and read from there.

A video's frames build on each other: a single one in the middle of a clip costs seconds, since everything from the last
keyframe on has to be decoded (docs/results.md has the times). A training wants them in random order, again and again.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.pictures import read_picture
from lapgs_wgpu.errors import InputError

# Flags of swscale: bicubic, accurate rounding, chroma interpolated along rows. Its default darkens by 1 or 2 levels.
EXACT_COLOURS = 0x4 | 0x40000 | 0x2000
COMPRESSION = 1  # of PNG: the next levels take twice as long for a tenth of the bytes
LARGEST_FRAME = 8192 * 8192  # pixels; the decoder holds several frames
WRITERS = min(8, os.cpu_count() or 1)  # threads that shrink and write the frames of the video that is being unpacked
_unpacking = Lock()  # one video at a time, with all processors: what is under way then has a bound


class Video:
    """A video file, its header checked. frames: how many. size: (width, height) in pixels."""

    def __init__(self, path: Path) -> None:
        """Reads the header, and counts the packets where it does not say how many frames there are. Raises InputError,
        also where PyAV is missing."""
        av = _pyav(path)
        self.path = path
        try:
            with av.open(str(path), metadata_errors="replace") as file:
                if not file.streams.video:
                    raise InputError(f"{path} has no video stream; give the camera's recording.")
                stream = file.streams.video[0]
                if stream.codec_context is None:
                    raise InputError(f"{path} is in a format that PyAV cannot decode; record or convert it to H.264.")
                self.size = (int(stream.width), int(stream.height))
                self.frames = stream.frames or sum(packet.size > 0 for packet in file.demux(stream))
        except (av.error.FFmpegError, OSError) as error:
            raise InputError(f"{path} is not a readable video ({error}); copy or record it again.") from None
        what = f"{path} has {self.frames} frames of {self.size[0]}x{self.size[1]} pixels"
        if self.frames < 1 or min(self.size) < 1:
            raise InputError(f"{what}; none is usable.")
        if self.size[0] * self.size[1] > LARGEST_FRAME:
            raise InputError(f"{what}, and at most {LARGEST_FRAME:,} pixels a frame are allowed; shrink it.")
        if self.frames > path.stat().st_size:
            raise InputError(f"{what}, it says, in {path.stat().st_size} bytes; copy it again.")

    def read(self, frame: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        """(H, W, 3) RGB of a frame, counted from 0, shrunk to (width, height). From any thread; the first call unpacks
        the whole video. Raises InputError."""
        folder = self._folder(size)
        if not folder.is_dir():
            with _unpacking:
                if not folder.is_dir():
                    self._unpack(folder, size)
        return read_picture(folder / f"{frame:05d}.png", size)

    def _folder(self, size: tuple[int, int]) -> Path:
        """Where this video, as it is now, is unpacked at this size."""
        try:
            stat = self.path.stat()
        except OSError as error:
            raise InputError(f"{self.path} cannot be read any more ({error.strerror}); put it back.") from None
        path = self.path.resolve()
        state = f"{stat.st_size:x}-{stat.st_mtime_ns:x}"
        place = "-".join(path.parent.parts[-2:]).strip("/")
        return cache_folder() / "frames" / place / f"{path.stem}-{size[0]}x{size[1]}-{state}"

    def _unpack(self, folder: Path, size: tuple[int, int]) -> None:
        """Write every frame as PNG. The folder appears only when it is whole."""
        av = _pyav(self.path)
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
                stream.codec_context.options = {"max_pixels": str(LARGEST_FRAME)}  # whatever the header says
                for frame in file.decode(stream):
                    if (frame.width, frame.height) != self.size:
                        raise InputError(
                            f"{self.path}: frame {count} has {frame.width}x{frame.height} pixels, and its header says "
                            f"{self.size[0]}x{self.size[1]}; record it with one size."
                        )
                    picture = frame.to_ndarray(format="rgb24", interpolation=EXACT_COLOURS)
                    if len(written) == 2 * WRITERS:  # the decoder is ahead; frames must not pile up
                        written.popleft().result()
                    written.append(pool.submit(_write, picture, size, unfinished / f"{count:05d}.png"))
                    count += 1
                for each in written:
                    each.result()
            if count != self.frames:
                raise InputError(f"{self.path} announces {self.frames} frames and holds {count}; copy it again.")
            unfinished.rename(folder)
        except av.error.FFmpegError as error:
            raise InputError(f"{self.path} cannot be decoded ({error}); copy or record it again.") from None
        except OSError as error:
            if not folder.is_dir():  # else another process was faster
                raise InputError(
                    f"{folder} cannot be written ({error.strerror or error}); make room there, or set XDG_CACHE_HOME "
                    f"to a folder with room for about {self.frames * size[0] * size[1] * 1.5e-9:.1f} GB a video."
                ) from None
        finally:
            if unfinished is not None:
                shutil.rmtree(unfinished, ignore_errors=True)


def cache_folder() -> Path:
    """Where what can be made again is kept: the system's folder for caches (XDG_CACHE_HOME, else ~/.cache)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lapgs_wgpu"


def _write(picture: NDArray[np.uint8], size: tuple[int, int], path: Path) -> None:
    image = Image.fromarray(picture)
    if image.size != size:
        image = image.resize(size, Image.Resampling.LANCZOS)  # the filter of the figures published for Neu3D
    image.save(path, compress_level=COMPRESSION)


def _pyav(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise InputError(
            f"{path} needs PyAV to be decoded: pip install 'lapgs-wgpu[video]', or extract its frames into "
            f"{path.with_suffix('')}/images/*.png."
        ) from None
    return av
