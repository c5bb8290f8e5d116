"""Videos without a screen: H.264 in mp4."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.camera import Camera

from .camera import ViewCamera
from .path import CameraPath

Shot = tuple[Camera, float]  # a camera and a time in the clip
PATHS = ("time", "view", "both")
_QUALITY = "18"  # H.264's crf: hardly to be told from the pictures
_MOST_FRAMES = 1_000_000


def count_frames(seconds: float, fps: float) -> int:
    """Of a video. Raises InputError where there would be none, or no end of them."""
    frames = round(seconds * fps)
    if not 1 <= frames <= _MOST_FRAMES:
        raise InputError(f"{seconds:g} s at {fps:g} frames a second are {frames} frames; give --seconds or --fps.")
    return frames


def clip_shots(camera: Camera, frames: int) -> Iterator[Shot]:
    """The clip once, from its first to its last moment, seen by a camera that stands."""
    return ((camera, share) for share in np.linspace(0, 1, frames).tolist())


def turn_shots(start: ViewCamera, size: tuple[int, int], frames: int, time: float | None) -> Iterator[Shot]:
    """Once around the focus, so that the first picture follows the last one. time: stands, or None: the clip once."""
    times = np.linspace(0, 1, frames).tolist()
    for number in range(frames):
        if number:
            start.orbit(2 * math.pi / frames, 0.0)
        yield start.camera(*size), times[number] if time is None else time


def path_shots(path: CameraPath, size: tuple[int, int], frames: int) -> Iterator[Shot]:
    """Along a camera path, from its first to its last key-frame."""
    for second in np.linspace(0, path.seconds, frames).tolist():
        pose, time = path.at(second)
        yield pose.camera(*size), time


def even(size: tuple[int, int]) -> tuple[int, int]:
    """The largest size within this one that yuv420p can have."""
    return max(2, size[0] // 2 * 2), max(2, size[1] // 2 * 2)


def write_video(
    file: Path,
    shots: Iterator[Shot],
    frames: int,
    fps: float,
    shoot: Callable[[Camera, float], NDArray[np.uint8]],
) -> None:
    """Draw the shots, all of one even size, into an mp4. Atomic: on any exception no file, or the old one, is there.

    Raises InputError where PyAV is missing or the file cannot be written.
    """
    try:
        import av
    except ImportError as error:
        raise InputError("writing mp4 needs PyAV: pip install 'lapgs-wgpu[video]'") from error
    rate = Fraction(fps).limit_denominator(65535)
    with atomic_write(file) as target:
        sink = _Sink(target)
        with Progress(frames, "frames") as progress, av.open(sink, "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate, options={"crf": _QUALITY, "preset": "medium"})
            stream.pix_fmt = "yuv420p"
            # Players guess the meaning of the values by the size unless they are stated: BT.601's matrix, as swscale
            # converts, in the limited range, and sRGB's primaries.
            context = stream.codec_context
            context.colorspace, context.color_primaries, context.color_trc, context.color_range = 6, 1, 13, 1
            for camera, time in shots:
                image = shoot(camera, time)
                if not context.is_open:  # the first encoded frame opens it
                    stream.height, stream.width = image.shape[:2]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
                sink.check()
                progress.step()
            container.mux(stream.encode(None))
        sink.check()


class _Sink:
    """The file, for PyAV, which must not learn of a full disk: it would encode on in a destructor, and print errors."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._error: OSError | None = None

    def check(self) -> None:
        """Raises what has kept the file from being written."""
        if self._error is not None:
            raise self._error

    def write(self, data: bytes) -> int:
        try:
            if self._error is None:
                self._file.write(data)
        except OSError as error:
            self._error = error
        return len(data)

    def seek(self, *place: int) -> int:
        try:
            return self._file.seek(*place)  # which writes what is still waiting
        except OSError as error:
            self._error = self._error or error
            return 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
