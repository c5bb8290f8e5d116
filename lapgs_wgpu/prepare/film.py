"""Films as phones and cameras record them: upright frames of square pixels in 8-bit RGB, each with its own time.

Those of high dynamic range are in HLG (phones) or PQ, with BT.2020 primaries. Transfer functions: ITU-R BT.2100. A
display of the web shows HDR's reference white at full level: brighter light is rolled off by a curve that keeps what is
below three quarters of it.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import THUMBNAIL, Pixels, Size, oriented, oriented_size, shrunk_size, size_text
from lapgs_wgpu.data.video_frames import EXACT_COLORS, INTERLACED, import_av, opened_film, orientation, pixel_aspect
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.progress import say

_FAST_BILINEAR = 0x1  # of swscale: exact enough for a thumbnail
Transfer = Literal["HLG", "PQ"]
TRANSFERS: dict[int, Transfer] = {18: "HLG", 16: "PQ"}  # by their numbers in ISO/IEC 23091-2

REFERENCE_WHITE = 203.0  # cd/m2, ITU-R BT.2408
PEAK = 1000.0  # cd/m2 of the display for which HLG is shown
KNEE = 0.75  # of the reference white: above it light is rolled off
TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32)
LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # of BT.2020's red, green, blue


class Frame(NamedTuple):
    """seconds: since the first frame. gray: (h, w) float32, levels 0 to 255, upright, longer side THUMBNAIL at most.
    pixels: (H, W, 3) RGB, upright, shrunk to at most so many pixels of the longer side. name: of its file, of which its
    image gets the name and the tags `exif`."""

    seconds: float
    gray: NDArray[np.float32]
    pixels: Callable[[int], Pixels]
    name: str = ""
    exif: bytes = b""


def _pixels(frame: Any, size: Size, turn: int, longer_side: int) -> Pixels:
    """size: of the frame's square pixels, not yet turned."""
    width, height = shrunk_size(size, longer_side)
    transfer = TRANSFERS.get(int(frame.color_trc))
    form = "rgb24" if transfer is None else "rgb48le"
    image = frame.to_ndarray(format=form, width=width, height=height, interpolation=EXACT_COLORS)
    return oriented(image if transfer is None else to_sdr(image, transfer), turn)


class Film:
    """A film whose header and first frame were checked.

    size: (width, height) of the upright frames, in pixels that are square. seconds: length as the header states it, 0
    if it does not. rate: frames a second, about. keeps_all: whether somebody chose the frames already.
    start: seconds into the film, of which the nearest frame becomes the first one.
    """

    keeps_all = False
    start = 0.0

    def __init__(self, path: Path) -> None:
        """Read the header, and decode the first frame. Raises InputError."""
        self.path = path
        with opened_film(path) as (file, stream):
            self._aspect = pixel_aspect(stream)
            length = stream.duration and stream.time_base and stream.duration * stream.time_base
            self.seconds = float(length or (file.duration or 0) / 1e6)  # of the container: microseconds
            self.rate = float(stream.average_rate or stream.guessed_rate or 30.0)
            first = next(file.decode(stream), None)
        if first is None:
            raise InputError(f"{path} has no frame that can be decoded; give the recording itself.")
        self._began = first.time or 0.0
        self.size: Size = oriented_size(_squared((first.width, first.height), self._aspect), orientation(first))
        if first.interlaced_frame:
            say(f"{path}: {INTERLACED}.")

    def frames(self) -> Iterator[Frame]:
        """Decode the frames in the order of their times. Raises InputError; a film that is damaged after its first
        frames ends there, which is said."""
        av = import_av(self.path)
        number, last, begin, damaged, guessed = 0, -1.0, None, False, False
        with opened_film(self.path) as (file, stream):
            try:
                for frame in file.decode(stream):
                    turn = orientation(frame)
                    shown = _squared((frame.width, frame.height), self._aspect)
                    size = oriented_size(shown, turn)
                    if size != self.size:
                        raise InputError(
                            f"{self.path}: frame {number} has {size_text(size)} pixels and the first has "
                            f"{size_text(self.size)}; cut the film where its size changes."
                        )
                    seconds = -1.0 if frame.time is None else frame.time - self._began
                    if number and seconds <= last:  # no time stamp, or one that was there before
                        guessed, seconds = True, last + 1 / self.rate
                    seconds = max(seconds, 0.0)
                    if seconds >= self.start - 0.5 / self.rate:
                        begin = seconds if begin is None else begin
                        yield Frame(seconds - begin, _gray(frame, shown, turn), partial(_pixels, frame, shown, turn))
                    number, last = number + 1, seconds
            except av.error.FFmpegError:
                if number < 2:
                    raise
                damaged = True
        if number < 2:
            raise InputError(f"{self.path} has {number} frames that can be decoded, and needs 2; give the recording.")
        if damaged or self.seconds > last + max(3 / self.rate, 0.1 * self.seconds):
            ends = f"states {self.seconds:.1f} s and ends after {last:.1f} s"
            say(f"{self.path} {ends}; copy it again if the rest is needed.")
        if guessed:
            say(f"{self.path}: frames without a time stamp of their own are taken as {self.rate:g} a second.")


def _squared(coded: Size, aspect: float) -> Size:
    """The size in which pixels are square: the width follows."""
    return max(1, round(coded[0] * aspect)), coded[1]


def _gray(frame: Any, size: Size, turn: int) -> NDArray[np.float32]:
    width, height = shrunk_size(size, THUMBNAIL)
    small = frame.to_ndarray(format="gray", width=width, height=height, interpolation=_FAST_BILINEAR)
    return oriented(small, turn).astype(np.float32)


def to_sdr(image: NDArray[np.uint16], transfer: Transfer) -> Pixels:
    """(H, W, 3) uint16 R'G'B' of BT.2100 -> (H, W, 3) uint8 sRGB."""
    signal = np.linspace(0, 1, 4096)  # 12 bits, more than films have
    if transfer == "HLG":  # relative light of the scene, by whose brightness the display changes it
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        table = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        light = table.astype(np.float32)[image >> 4]
        light *= (PEAK / REFERENCE_WHITE) * np.maximum(light @ LUMINANCE, 1e-6)[..., None] ** np.float32(0.2)
    else:  # light of the display
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        root = signal ** (1 / m2)
        table = 10000 / REFERENCE_WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
        light = table.astype(np.float32)[image >> 4]
    light = np.clip(light @ TO_BT709.T, 0, None)
    strongest = light.max(axis=2, keepdims=True)
    above = np.maximum(strongest - KNEE, 0) / (1 - KNEE)  # is bent, with the same slope at the knee
    rolled_off = np.where(strongest <= KNEE, strongest, KNEE + (1 - KNEE) * above / (1 + above)).astype(np.float32)
    light *= rolled_off / np.maximum(strongest, 1e-6)  # of all channels alike, which keeps the hue
    shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.floor(np.clip(shown, 0, 1) * 255 + 0.5).astype(np.uint8)
