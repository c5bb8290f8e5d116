"""At what moment films of one event begin, by their sound: its onsets are compared at all shifts."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lapgs_wgpu.data.video_frames import import_av
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.poses import Floats
from lapgs_wgpu.progress import say

RATE, STEP = 8000, 40  # samples a second; of one value
SURE = 8.0  # standard deviations of the likeness at all shifts, by which that of the best one stands out


def start_together(films: Sequence[Film]) -> None:
    """Let all films begin at the first moment that all of them heard, else at their first frames; says which."""
    heard = [onsets(film.path) if film.path.is_file() else np.zeros(0) for film in films]
    shifts = []
    for film, sound in zip(films, heard, strict=True):
        shift, likeness = shift_of(heard[0], sound)
        if likeness < SURE:
            lacks = f" in common with {films[0].path.name}" if sound.any() and film is not films[0] else ""
            say(
                f"the first frames of all {len(films)} films are taken to be of one moment: {film.path.name} has no "
                f"sound{lacks}."
            )
            return
        shifts.append(shift)
    for film, shift in zip(films, shifts, strict=True):
        film.start = shift - min(shifts)
    starts = ", ".join(f"{film.path.name} at {film.start:.2f} s" for film in films)
    say(f"the films are brought into step by their sound: they begin together in {starts}.")


def onsets(path: Path) -> Floats:
    """(n,) how much louder the sound of a film becomes, RATE / STEP values a second from its first frame on; none where
    it has no sound."""
    av = import_av(path)
    wave, late = [np.zeros(STEP)], None
    try:
        with av.open(str(path), metadata_errors="replace") as file:
            picture = file.streams.video[0]
            begin = float((picture.start_time or 0) * picture.time_base)
            resampler = av.AudioResampler(format="flt", layout="mono", rate=RATE)
            for frame in file.decode(audio=0) if file.streams.audio else ():
                late = (frame.time or 0.0) - begin if late is None else late
                wave += [part.to_ndarray()[0] for part in resampler.resample(frame)]
    except (av.error.FFmpegError, OSError):
        return np.zeros(0)
    sound = np.concatenate([np.zeros(max(0, round((late or 0.0) * RATE))), *wave])
    power = np.log(np.square(sound[: len(sound) // STEP * STEP].reshape(-1, STEP)).mean(axis=1) + 1e-8)
    return np.maximum(np.diff(power), 0)


def shift_of(one: Floats, other: Floats) -> tuple[float, float]:
    """By how many seconds what is heard comes later in the other film, and by how many standard deviations the likeness
    there stands out, 0 where one has no sound."""
    from scipy.signal import correlate  # slow to import

    if not (len(one) and len(other)):
        return 0.0, 0.0
    likeness = correlate(other - other.mean(), one - one.mean())
    best = int(likeness.argmax())
    return (best - len(one) + 1) * STEP / RATE, float(likeness[best] / max(likeness.std(), 1e-12))
