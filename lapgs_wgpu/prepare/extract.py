"""Frames worth having: of each short span of a film the sharpest one, without repeated and blurred ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from lapgs_wgpu.data.thumbnails import blurred, repeats, sharpness
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.film import Film, FilmFrame
from lapgs_wgpu.progress import Progress

FRAMES_PER_SECOND = 10.0  # of one moving camera: poses change slowly
STILL_FRAMES_PER_SECOND = 30.0  # of cameras on tripods, which need one pose for all their frames
MOST_IMAGES = 300  # of a film, unless --fps asks for more
LONGER_SIDE = 1920  # pixels of the images, unless --size asks for more
BLACK = 6.0  # levels of 255: the mean of a black image
JPEG_QUALITY = 95


@dataclass(frozen=True)
class Picture:
    """An extracted image. name: below images/. seconds: since the first frame of its film. sharpness: variance of the
    Laplacian. brightness: mean gray level, 0 to 255; both at the thumbnail's size."""

    name: str
    seconds: float
    sharpness: float
    brightness: float


@dataclass(frozen=True)
class Extraction:
    """The images of a film in order, how many a second were asked for, the number of frames they were chosen from,
    whether the camera stands still, and how many spans gave none since their best frame was repeated or blurred."""

    pictures: Sequence[Picture]
    fps: float
    frames: int
    still: bool = False
    repeated: int = 0
    blurred: int = 0

    def __str__(self) -> str:
        left_out = [f"{n} {what}" for n, what in ((self.repeated, "repeated"), (self.blurred, "blurred")) if n]
        out = f"; {' and '.join(left_out)} left out" if left_out else ""
        taken = "one" if self.still else "the sharpest"
        return f"{len(self.pictures)} images of {self.frames} frames, {taken} of each {1 / self.fps:.2g} s{out}"


def images_per_second(film: Film, asked: float | None, *, still: bool) -> float:
    """Images per second of film: as asked, else so many that a film gives at most MOST_IMAGES."""
    if asked is not None:
        return asked
    usual = STILL_FRAMES_PER_SECOND if still else FRAMES_PER_SECOND
    return min(usual, MOST_IMAGES / film.seconds) if film.seconds > 0 else usual


def extract(film: Film, images: Path, prefix: str, fps: float, longer_side: int, *, still: bool) -> Extraction:
    """Write JPEG images, at most `fps` per second, whose names are their times in milliseconds.

    images: folder of all images. prefix: of the names, such as "cam00/". still: the camera stands still; then frames
    are taken in step, as other cameras film the same moments, and none is left out.
    Raises InputError for a film that is black or gives less than 2 images.
    """
    folder = images / prefix
    folder.mkdir(parents=True, exist_ok=True)
    pictures: list[Picture] = []
    frames, repeated, before = 0, 0, None
    with Progress(max(1, math.ceil(film.seconds)), f"seconds of {film.path.name}") as progress:
        for group in _spans(film, fps):
            frames += len(group.sharpness)
            best = group.first if still else group.best
            progress.at(max(1, math.floor(best.seconds)))
            if not still and before is not None and repeats(best.gray, before):
                repeated += 1
                continue
            before = best.gray
            name = f"{prefix}{round(1000 * best.seconds):08d}.jpg"
            Image.fromarray(best.pixels(longer_side)).save(images / name, quality=JPEG_QUALITY, subsampling=0)
            pictures.append(Picture(name, best.seconds, sharpness(best.gray), float(best.gray.mean())))
    if pictures and max(picture.brightness for picture in pictures) < BLACK:
        raise InputError(
            f"{film.path} is black: the brightest of its {len(pictures)} images has a mean of "
            f"{max(picture.brightness for picture in pictures):.1f} of 255 levels; film with light, without a lens cap."
        )
    bad = blurred(np.array([picture.sharpness for picture in pictures]))
    kept = pictures if still else [picture for picture, each in zip(pictures, bad, strict=True) if not each]
    for picture in set(pictures) - set(kept):
        (images / picture.name).unlink()
    if len(kept) < 2:
        raise InputError(
            f"{film.path} gives {len(kept)} images at {fps:g} a second ({frames} frames, {repeated} of them repeat "
            "another); film something that moves, for at least a few seconds."
        )
    return Extraction(kept, fps, frames, still, repeated, len(pictures) - len(kept))


@dataclass
class _Span:
    """Frames of one span: the first and the sharpest of them, and the sharpness of all."""

    first: FilmFrame
    best: FilmFrame
    sharpness: list[float]


def _spans(film: Film, fps: float) -> Iterator[_Span]:
    """The frames of each 1 / fps seconds; only two of a span are kept, whatever the film's length."""
    number, span = -1, None
    for frame in film.frames():
        value = sharpness(frame.gray)
        now = math.floor(frame.seconds * fps + 1e-3)  # 1 ms of 1 s: stamps are rounded
        if span is None or now > number:
            if span is not None:
                yield span
            number, span = now, _Span(frame, frame, [value])
            continue
        if value > max(span.sharpness):
            span.best = frame
        span.sharpness.append(value)
    if span is not None:
        yield span


def common_end(extractions: Sequence[Extraction]) -> float:
    """Seconds that all cameras film: the end of the shortest film."""
    return min(each.pictures[-1].seconds for each in extractions)


def common_moments(extractions: Sequence[Extraction], most: int) -> list[tuple[Picture, ...]]:
    """At most `most` moments that all cameras filmed, in order, a picture of each camera.

    A moment is that of a picture of the first camera to which each other one has a picture less than half a span away.
    Of each equal share of the moments the one is taken whose pictures are closest together in time.
    """
    times = [np.array([picture.seconds for picture in each.pictures]) for each in extractions]
    found: list[tuple[float, tuple[Picture, ...]]] = []
    for now in times[0].tolist():
        nearest = [int(np.abs(own - now).argmin()) for own in times]
        apart = max(abs(float(own[i]) - now) for own, i in zip(times, nearest, strict=True))
        if apart < 0.5 / extractions[0].fps:
            chosen = tuple(each.pictures[i] for each, i in zip(extractions, nearest, strict=True))
            found.append((apart, chosen))
    shares = np.array_split(np.arange(len(found)), min(most, len(found)))
    return [found[min(share, key=lambda i: (round(found[i][0], 4), i))][1] for share in shares]


def shortened(extraction: Extraction, images: Path, seconds: float) -> Extraction:
    """Without the images after `seconds`, whose files are removed."""
    kept = [picture for picture in extraction.pictures if picture.seconds <= seconds + 0.5 / extraction.fps]
    for picture in extraction.pictures[len(kept) :]:
        (images / picture.name).unlink()
    return replace(extraction, pictures=kept)
