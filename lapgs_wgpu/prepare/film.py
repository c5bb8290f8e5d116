"""Films as phones and cameras record them: upright frames of square pixels in 8-bit RGB, each with its own time.

Of each span of a film the sharpest frame, of cameras that stand still the first one, becomes an image of a capture.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.images import (
    THUMBNAIL,
    Pixels,
    Size,
    blurred,
    oriented,
    oriented_size,
    repeats,
    sharpness,
    shrunk_size,
    size_text,
)
from lapgs_wgpu.data.video_frames import EXACT_COLORS, INTERLACED, import_av, opened_film, orientation, pixel_aspect
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.progress import counted, say

FRAMES_PER_SECOND = 10.0  # of one moving camera: poses change slowly
STILL_FRAMES_PER_SECOND = 30.0  # of cameras on tripods, which need one pose for all their frames
LEAST_IMAGES = 120  # of one moving camera, where the film has so many frames
MOST_IMAGES = 300  # of a film, unless --fps asks for more
LONGER_SIDE = 1920  # pixels: larger frames are shrunk
BLACK = 6.0  # levels of 255: the mean of a black image
_FAST_BILINEAR = 0x1  # of swscale: exact enough for a thumbnail

Transfer = Literal["HLG", "PQ"]  # of high dynamic range, with BT.2020's primaries; phones record HLG
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


class Picture(NamedTuple):
    """A written image. name: below the images' folder. seconds: since the first frame of its film."""

    name: str
    seconds: float


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
        self.size = self._shown(first)
        if first.interlaced_frame:
            say(f"{path}: {INTERLACED}.")

    def _shown(self, frame: Any) -> Size:
        """(width, height) of a frame as it is shown, in square pixels."""
        return oriented_size((max(1, round(frame.width * self._aspect)), frame.height), orientation(frame))

    def _pixels(self, frame: Any, longer_side: int, *, gray: bool = False) -> Pixels:
        """(H, W, 3), or (H, W) gray."""
        turn = orientation(frame)
        width, height = oriented_size(shrunk_size(self.size, longer_side), turn)  # not yet turned
        transfer = None if gray else TRANSFERS.get(int(frame.color_trc))
        form, way = ("gray", _FAST_BILINEAR) if gray else ("rgb48le" if transfer else "rgb24", EXACT_COLORS)
        image = frame.to_ndarray(format=form, width=width, height=height, interpolation=way)
        return oriented(to_sdr(image, transfer) if transfer else image, turn)

    def frames(self) -> Iterator[Frame]:
        """Decode the frames in the order of their times. Raises InputError; a film that is damaged after its first
        frames ends there, which is said."""
        av = import_av(self.path)
        number, last, begin, damaged, guessed = 0, -1.0, None, False, False
        with opened_film(self.path) as (file, stream):
            try:
                for frame in file.decode(stream):
                    if (size := self._shown(frame)) != self.size:
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
                        gray = self._pixels(frame, THUMBNAIL, gray=True).astype(np.float32)
                        yield Frame(seconds - begin, gray, partial(self._pixels, frame))
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


def to_sdr(image: NDArray[np.uint16], transfer: Transfer) -> Pixels:
    """(H, W, 3) uint16 R'G'B' of ITU-R BT.2100 -> (H, W, 3) uint8 sRGB, whose full level is the reference white."""
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


def images_per_second(films: Sequence[Film], asked: float | None) -> float:
    """As asked, else so many that the shortest film gives at most MOST_IMAGES: several films have one rate."""
    if asked is not None:
        return asked
    usual = min(STILL_FRAMES_PER_SECOND, *(film.rate for film in films))
    if len(films) == 1:  # a short film gives more, each one of the same number of frames
        frames = films[0].rate * films[0].seconds
        usual = max(FRAMES_PER_SECOND, films[0].rate / max(1, math.ceil(frames / LEAST_IMAGES - 1e-6)))
        usual = films[0].rate if films[0].keeps_all else usual
    return min(usual, MOST_IMAGES / max(min(film.seconds for film in films), 1e-3))


def extract(film: Film, images: Path, fps: float) -> list[Picture]:
    """Write the images of a camera that moves, at most `fps` a second, those of films named by milliseconds. Raises
    InputError for a film that is black or gives less than 2 images."""
    pictures, sharp, repeated, before = list[Picture](), list[float](), 0, None
    for _, frames in spans(film, fps):
        best = max(frames, key=lambda frame: sharpness(frame.gray))
        if before is not None and repeats(best.gray, before):
            repeated += 1
            continue
        before = best.gray
        pictures.append(write_image(best, best.pixels(LONGER_SIDE), images))
        sharp.append(sharpness(best.gray))
    soft = blurred(np.array(sharp))
    for picture in itertools.compress(pictures, soft):
        (images / picture.name).unlink()
    kept = list(itertools.compress(pictures, ~soft))
    told = f"{film.path}: {len(kept)} images, the sharpest frame of each {1 / fps:.2g} s; left out: {repeated} "
    told += f"repeated, {len(pictures) - len(kept)} blurred"
    if len(kept) < 2:
        raise InputError(f"{told}; give a longer recording, a part in which something moves, or a larger --fps.")
    say(told)
    return kept


def spans(film: Film, fps: float) -> Iterator[tuple[int, Iterator[Frame]]]:
    """The number of each 1 / fps seconds of a film, and its frames. Raises InputError for a film that is black."""
    return itertools.groupby(_lit(film), lambda frame: math.floor(frame.seconds * fps + 1e-3))  # stamps are rounded


def _lit(film: Film) -> Iterator[Frame]:
    brightest = 0.0
    for frame in counted(film.frames(), max(1, round(film.seconds * film.rate)), f"frames of {film.path.name}"):
        brightest = max(brightest, float(frame.gray.mean()))
        yield frame
    if brightest < BLACK:
        raise InputError(
            f"{film.path} is black: its brightest frame has a mean of {brightest:.1f} of 255 levels, and {BLACK:g} are "
            "needed; film with more light."
        )


def write_image(frame: Frame, pixels: Pixels, images: Path, prefix: str = "") -> Picture:
    """Write a frame's image as a JPEG file. prefix: of its name, such as "cam00/"."""
    name = f"{prefix}{frame.name or f'{round(1000 * frame.seconds):08d}'}.jpg"
    (images / name).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(images / name, quality=95, subsampling=0, exif=frame.exif)
    return Picture(name, frame.seconds)
