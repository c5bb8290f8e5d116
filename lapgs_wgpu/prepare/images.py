"""The images of a capture: of each span of a film the sharpest frame, without repeated and blurred ones."""

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from lapgs_wgpu.data.images import Pixels, blurred, repeats, sharpness
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.film import Film, Frame
from lapgs_wgpu.progress import counted, say

FRAMES_PER_SECOND = 10.0  # of one moving camera: poses change slowly
STILL_FRAMES_PER_SECOND = 30.0  # of cameras on tripods, which need one pose for all their frames
LEAST_IMAGES = 60  # of one moving camera, where the film has so many frames
MOST_IMAGES = 300  # of a film, unless --fps asks for more
LONGER_SIDE = 1920  # pixels: larger frames are shrunk
BLACK = 6.0  # levels of 255: the mean of a black image


class Picture(NamedTuple):
    """A written image. name: below the images' folder. seconds: since the first frame of its film."""

    name: str
    seconds: float


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
    """Write the images of a camera that moves, at most `fps` a second, whose names are their files', else their times
    in milliseconds.

    Raises InputError for a film that is black or gives less than 2 images.
    """
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
