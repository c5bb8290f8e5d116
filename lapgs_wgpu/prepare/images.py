"""The images of a capture: of each span of a film the sharpest frame, without repeated and blurred ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from lapgs_wgpu.data.images import size_text
from lapgs_wgpu.data.thumbnails import blurred, repeats, sharpness
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.film import Film, FilmFrame
from lapgs_wgpu.progress import Progress, say

FRAMES_PER_SECOND = 10.0  # of one moving camera: poses change slowly
STILL_FRAMES_PER_SECOND = 30.0  # of cameras on tripods, which need one pose for all their frames
LEAST_IMAGES = 60  # of one moving camera, where the film has so many frames
MOST_IMAGES = 300  # of a film, unless --fps asks for more
LONGER_SIDE = 1920  # pixels: larger frames are shrunk
BLACK = 6.0  # levels of 255: the mean of a black image
JPEG_QUALITY = 95


class Picture(NamedTuple):
    """A written image. name: below images/. seconds: since the first frame of its film."""

    name: str
    seconds: float


def images_per_second(films: Sequence[Film], asked: float | None) -> float:
    """As asked, else so many that the shortest film gives at most MOST_IMAGES: several films have one rate."""
    if asked is not None:
        return asked
    usual = STILL_FRAMES_PER_SECOND
    if len(films) == 1:  # a short film gives more, each one of the same number of frames
        frames = films[0].rate * films[0].seconds
        usual = max(FRAMES_PER_SECOND, films[0].rate / max(1, math.ceil(frames / LEAST_IMAGES - 1e-6)))
    return min(usual, MOST_IMAGES / max(min(film.seconds for film in films), 1e-3))


def extract(film: Film, images: Path, fps: float) -> list[Picture]:
    """Write the images of a camera that moves, at most `fps` a second, whose names are their times in milliseconds.

    Raises InputError for a film that is black or gives less than 2 images.
    """
    pictures: list[Picture] = []
    sharp: list[float] = []
    frames, repeated, before = 0, 0, None
    for span in _spans(film, fps):
        frames += span.frames
        if before is not None and repeats(span.best.gray, before):
            repeated += 1
            continue
        before = span.best.gray
        pictures.append(_write(span.best, images, ""))
        sharp.append(span.sharpness)
    kept = [picture for picture, soft in zip(pictures, blurred(np.array(sharp)), strict=True) if not soft]
    for picture in set(pictures) - set(kept):
        (images / picture.name).unlink()
    if len(kept) < 2:
        raise InputError(
            f"{film.path} gives {len(kept)} images at {fps:g} a second ({frames} frames, {repeated} of them repeat "
            "another); film something that moves, for at least a few seconds."
        )
    _tell(film, f"{len(kept)} images of {frames} frames, the sharpest of each {1 / fps:.2g} s; left out: {repeated} "
                f"repeated, {len(pictures) - len(kept)} blurred")  # fmt: skip
    return kept


def extract_in_step(films: Sequence[Film], images: Path, fps: float) -> list[list[Picture]]:
    """Write the images of cameras that stand still, below cam00, cam01, ...: as many of each, of the same times.

    None is left out, and all films end with the shortest. Raises InputError for films of different sizes.
    """
    cameras = []
    for number, film in enumerate(films):
        pictures = [_write(span.first, images, f"cam{number:02d}/") for span in _spans(film, fps)]
        _tell(film, f"{len(pictures)} images, one of each {1 / fps:.2g} s")
        if film.size != films[0].size:
            raise InputError(
                f"{film.path} is {size_text(film.size)} pixels and {films[0].path} is {size_text(films[0].size)}; film "
                "with one size."
            )
        cameras.append(pictures)
    ends = [pictures[-1].seconds for pictures in cameras]
    if max(ends) > min(ends) + 1 / fps:
        say(f"the films are {min(ends):.2f} to {max(ends):.2f} s long; all are cut to {min(ends):.2f} s.")
    for pictures in cameras:
        while pictures[-1].seconds > min(ends) + 0.5 / fps:
            (images / pictures.pop().name).unlink()
    return cameras


def common_times(cameras: Sequence[Sequence[Picture]], fps: float, most: int) -> list[tuple[Picture, ...]]:
    """At most `most` times that all cameras filmed, in order: a picture of each camera.

    A time is that of a picture of the first camera to which each other one has a picture less than half a span away.
    Of each equal share of the times the one is taken whose pictures are closest together.
    """
    times = [np.array([picture.seconds for picture in pictures]) for pictures in cameras]
    found: list[tuple[float, tuple[Picture, ...]]] = []
    for now in times[0].tolist():
        nearest = [int(np.abs(own - now).argmin()) for own in times]
        apart = max(abs(float(own[i]) - now) for own, i in zip(times, nearest, strict=True))
        if apart < 0.5 / fps:
            found.append((apart, tuple(pictures[i] for pictures, i in zip(cameras, nearest, strict=True))))
    shares = np.array_split(np.arange(len(found)), min(most, len(found)))
    return [found[min(share, key=lambda i: (round(found[i][0], 4), i))][1] for share in shares]


@dataclass
class _Span:
    """The frames of one span of time: the first and the sharpest of them, how sharp that is, and their number."""

    first: FilmFrame
    best: FilmFrame
    sharpness: float
    frames: int = 1


def _spans(film: Film, fps: float) -> Iterator[_Span]:
    """The frames of each 1 / fps seconds; only two of a span are kept, whatever the film's length.

    Raises InputError for a film that is black.
    """
    number, span, brightest = -1, None, 0.0
    with Progress(max(1, math.ceil(film.seconds)), f"seconds of {film.path.name}") as progress:
        for frame in film.frames():
            brightest = max(brightest, float(frame.gray.mean()))
            value = sharpness(frame.gray)
            now = math.floor(frame.seconds * fps + 1e-3)  # 1 ms of 1 s: stamps are rounded
            if span is None or now > number:
                if span is not None:
                    yield span
                    if math.floor(frame.seconds) > math.floor(span.first.seconds):
                        progress.at(math.floor(frame.seconds))
                number, span = now, _Span(frame, frame, value)
                continue
            if value > span.sharpness:
                span.best, span.sharpness = frame, value
            span.frames += 1
    if brightest < BLACK:
        raise InputError(
            f"{film.path} is black: its brightest frame has a mean of {brightest:.1f} of 255 levels; film with light, "
            "without a lens cap."
        )
    if span is not None:
        yield span


def _write(frame: FilmFrame, images: Path, prefix: str) -> Picture:
    """Write a JPEG image. prefix: of its name, such as "cam00/"."""
    name = f"{prefix}{round(1000 * frame.seconds):08d}.jpg"
    (images / name).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(frame.pixels(LONGER_SIDE)).save(images / name, quality=JPEG_QUALITY, subsampling=0)
    return Picture(name, frame.seconds)


def _tell(film: Film, what: str) -> None:
    say(f"{film.path}: {what}")
    for note in film.notes:
        say(note)
