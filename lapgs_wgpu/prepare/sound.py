"""At what moment films of one event begin, by their sound: its onsets are compared at all shifts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.video_frames import import_av
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.progress import say

RATE, STEP = 8000, 40  # samples a second; of one value
SURE = 8.0  # standard deviations of the likeness at all shifts, by which that of the best one stands out
Floats = NDArray[np.float64]


def start_together(films: Sequence[Film]) -> None:
    """Let all films begin at the first moment that all of them heard, else at their first frames; says which."""
    heard = [onsets(film.path) if film.path.is_file() else None for film in films]
    shifts = []
    for each in heard:
        if heard[0] is None or each is None:
            break
        shift, likeness = shift_of(heard[0], each)
        if likeness < SURE:
            break
        shifts.append(shift)
    if len(shifts) < len(films):
        say(
            f"the first frames of all {len(films)} films are taken to be of one moment: {films[len(shifts)].path.name} "
            f"has no sound in common with {films[0].path.name}."
        )
        return
    for film, shift in zip(films, shifts, strict=True):
        film.start = shift - min(shifts)
    starts = ", ".join(f"{film.path.name} at {film.start:.2f} s" for film in films)
    say(f"the films are brought into step by their sound: they begin together in {starts}.")


def onsets(path: Path) -> Floats | None:
    """(n,) how much louder the sound of a film becomes, RATE / STEP values a second from its first frame on; None where
    it has none."""
    av = import_av(path)
    try:
        with av.open(str(path), metadata_errors="replace") as file:
            if not file.streams.audio:
                return None
            picture = file.streams.video[0]
            begin = float((picture.start_time or 0) * picture.time_base)
            resampler, wave, late = av.AudioResampler(format="flt", layout="mono", rate=RATE), [np.zeros(STEP)], None
            for frame in file.decode(audio=0):
                late = (frame.time or 0.0) - begin if late is None else late
                wave += [part.to_ndarray()[0] for part in resampler.resample(frame)]
    except (av.error.FFmpegError, OSError):
        return None
    sound = np.concatenate([np.zeros(max(0, round((late or 0.0) * RATE))), *wave])
    power = np.log(np.square(sound[: len(sound) // STEP * STEP].reshape(-1, STEP)).mean(axis=1) + 1e-8)
    return np.maximum(np.diff(power), 0)


def shift_of(one: Floats, other: Floats) -> tuple[float, float]:
    """By how many seconds what is heard comes later in the other film, and by how many standard deviations the likeness
    there stands out."""
    from scipy.signal import correlate  # slow to import

    likeness = correlate(other - other.mean(), one - one.mean())
    best = int(likeness.argmax())
    return (best - len(one) + 1) * STEP / RATE, float(likeness[best] / max(likeness.std(), 1e-12))
