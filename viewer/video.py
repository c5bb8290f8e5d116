"""Write videos (H.264 in MP4), and the cameras of their frames."""

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import optional_module
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.progress import counted
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.camera import ViewCamera

TimedCamera = tuple[Camera, float]  # a camera and a time in the clip
_QUALITY = "18"  # H.264's crf: hardly distinguishable from the rendered images


def orbit_views(
    start: ViewCamera,
    size: tuple[int, int],
    frames: int,
    time: float | None,
    arc: tuple[float, float] | None = None,
) -> Iterator[TimedCamera]:
    """Go around the focus once. time: fixed, in [0, 1]; None plays the clip once. arc: swing to these degrees
    clockwise and counterclockwise (`InitialView.arc`) instead of going all around."""
    for number, passed in enumerate(np.linspace(0, 1, frames).tolist()):
        if number:
            start.orbit(_turned(number / frames, arc) - _turned((number - 1) / frames, arc), 0.0)
        yield start.camera(*size), passed if time is None else time


def _turned(share: float, arc: tuple[float, float] | None) -> float:
    """Return the radians clockwise after a share of a closed orbit."""
    if arc is None:
        return 2 * math.pi * share
    wave = math.sin(2 * math.pi * share)
    return math.radians(wave * (arc[0] if wave > 0 else arc[1]))


def write_video(
    file: Path,
    cameras: Iterator[TimedCamera],
    frames: int,
    fps: float,
    render: Callable[[Camera, float], NDArray[np.uint8]],
) -> None:
    """Render the cameras, all of one even size, to an MP4 file. Atomic: on any exception the old file stays, if any.

    Raises InputError where PyAV is missing or the file cannot be written.
    """
    av = optional_module("av", "writing mp4 needs PyAV", "video")
    rate = Fraction(fps).limit_denominator(65535)
    with (
        atomic_write(file) as target,
        av.open(f"file:{target.name}", "w", format="mp4") as container,
    ):
        stream = container.add_stream("libx264", rate, options={"crf": _QUALITY, "preset": "medium"})
        stream.pix_fmt = "yuv420p"
        # Without these, players guess the color space from the image size: BT.601's matrix and limited range, as
        # swscale converts, and sRGB's primaries.
        context = stream.codec_context
        context.colorspace, context.color_primaries, context.color_trc, context.color_range = 6, 1, 13, 1
        for camera, time in counted(cameras, frames, "frames"):
            image = render(camera, time)
            if not context.is_open:  # the first encoded frame opens it
                stream.height, stream.width = image.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode(None))
