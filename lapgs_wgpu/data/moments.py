"""When the pictures of one's own capture were taken, and which of them are held out for testing (docs/own-data.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from lapgs_wgpu.data.fields import finite, read_json
from lapgs_wgpu.errors import InputError

TIMES = "times.json"
EVERY = 8  # of the moments one is tested on: the fifth, the thirteenth, ...
FIRST = 4
CAMERAS = 3  # with so many cameras or more the first one is held out instead


class Picture(NamedTuple):
    """name: as times.json calls it, relative to the folder of pictures. camera: who took it, its folder's name."""

    name: str
    camera: str


def times_of(pictures: Sequence[Picture], folder: Path) -> tuple[list[float], list[str]]:
    """The time of each picture, from 0, the first, to 1, the last; and warnings.

    From times.json in the folder, where there is one, in any unit; else from the numbers of the frames in the names.
    Raises InputError where neither says it.
    """
    path = folder / TIMES
    values = _listed(pictures, path) if path.is_file() else [float(number) for number in frame_numbers(pictures)]
    return from_0_to_1(values), disorder(pictures, values)


def time_source(folder: Path) -> str:
    """What errors call the times that `times_of` reads."""
    path = folder / TIMES
    return str(path) if path.is_file() else f"the frame numbers in the names of {folder}"


def from_0_to_1(values: Sequence[float]) -> list[float]:
    """The first at 0 and the last at 1; all 0 where they are equal."""
    first, last = min(values), max(values)
    return [(value - first) / (last - first) if last > first else 0.0 for value in values]


def _listed(pictures: Sequence[Picture], path: Path) -> list[float]:
    times = read_json(path, "a time for each picture")
    missing = [picture.name for picture in pictures if picture.name not in times]
    if missing:
        example = f", such as {next(iter(times))[:80]}" if times else ""
        raise InputError(
            f"{path} has {len(times)} times{example}, but none for {len(missing)} of {len(pictures)} pictures, such "
            f"as {missing[0]}; name each picture as it is named below images/."
        )
    return [finite(times[picture.name], f"the time of {picture.name}", path) for picture in pictures]


def frame_numbers(pictures: Sequence[Picture]) -> list[int]:
    """The number in each name that counts the frames: the only one that differs between the pictures of a camera.
    Raises InputError where none does, or more than one."""
    found: dict[int, int] = {}
    for camera in dict.fromkeys(picture.camera for picture in pictures):
        mine = [i for i, picture in enumerate(pictures) if picture.camera == camera]
        names = [pictures[i].name for i in mine]
        rows = [[int(digits) for digits in re.findall(r"\d+", Path(name).stem)] for name in names]
        shapes = {len(row) for row in rows}
        if shapes == {0} or len(shapes) > 1:
            odd = next(name for name, row in zip(names, rows, strict=True) if len(row) != max(shapes) or not row)
            raise InputError(
                f"the name {odd} does not say which frame it is: {names[0]} has {len(rows[0])} numbers and it has "
                f"{len(rows[names.index(odd)])}; write the times into {TIMES}, or number the frames."
            )
        varying = [column for column in range(len(rows[0])) if len({row[column] for row in rows}) > 1]
        if len(varying) > 1:
            raise InputError(
                f"{names[0]} and {names[-1]} differ in {len(varying)} numbers, and it is not clear which one counts "
                f"the frames; write the times into {TIMES}, or put each camera's pictures into a folder of its own."
            )
        column = varying[0] if varying else len(rows[0]) - 1
        for i, row in zip(mine, rows, strict=True):
            found[i] = row[column]
        numbers: dict[int, str] = {}
        for name, row in zip(names, rows, strict=True):
            if row[column] in numbers:
                raise InputError(f"{name} has the frame number {row[column]}, as {numbers[row[column]]} has.")
            numbers[row[column]] = name
    return [found[i] for i in range(len(pictures))]


def disorder(pictures: Sequence[Picture], times: Sequence[float]) -> list[str]:
    """A warning where pictures of a camera, in the order of the frames that their names count, have times that go
    back; and one where cameras have no time in common."""
    warnings = []
    spans: dict[str, tuple[float, float]] = {}
    for camera in dict.fromkeys(picture.camera for picture in pictures):
        mine = [(picture, time) for picture, time in zip(pictures, times, strict=True) if picture.camera == camera]
        spans[camera] = min(time for _, time in mine), max(time for _, time in mine)
        try:
            numbers = frame_numbers([picture for picture, _ in mine])
        except InputError:
            continue  # names that count nothing have no order
        ordered = [entry for _, entry in sorted(zip(numbers, mine, strict=True), key=lambda pair: pair[0])]
        back = [(a, b) for a, b in pairwise(ordered) if b[1] < a[1]]
        if back:
            (first, at), (second, then) = back[0]
            warnings.append(
                f"frames are out of order: time goes back {len(back)} times in {len(ordered)} pictures, first from "
                f"{first.name} at {at:g} to {second.name} at {then:g}; check the times."
            )
    names = list(spans)
    apart = [name for name in names[1:] if spans[name][0] > spans[names[0]][1] or spans[name][1] < spans[names[0]][0]]
    if apart:
        (a, b), (c, d) = spans[names[0]], spans[apart[0]]
        warnings.append(
            f"cameras film at different times: {names[0]} from {a:g} to {b:g} and {apart[0]} from {c:g} to {d:g}; "
            "where they filmed together, number their frames from the same moment on."
        )
    return warnings


def held_out(pictures: Sequence[Picture], times: Sequence[float]) -> set[int]:
    """Which pictures are tested on: those of the first camera, of three or more; else every eighth moment's, from the
    fifth moment on. Raises InputError where too few are left."""
    cameras = sorted({picture.camera for picture in pictures}, key=natural)
    if len(cameras) >= CAMERAS:
        return {i for i, picture in enumerate(pictures) if picture.camera == cameras[0]}
    # Where nothing moves, each picture stands for a moment.
    moments = sorted(set(times)) if len(set(times)) > 1 else []
    if moments:
        tested = set(moments[FIRST::EVERY])
        chosen = {i for i, time in enumerate(times) if time in tested}
    else:
        chosen = set(range(len(pictures))[FIRST::EVERY])
    if not chosen:
        raise InputError(
            f"{len(pictures)} pictures at {max(len(moments), 1)} times are too few: every eighth moment from the "
            "fifth on is held out for testing, so at least 5 are needed, or 3 cameras, of which the first is held out."
        )
    return chosen


def natural(name: str) -> tuple[tuple[int, int | str], ...]:
    """A key that puts cam2 before cam10."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts)


def write_times(folder: Path, times: dict[str, float]) -> None:
    """times.json: seconds of each picture."""
    (folder / TIMES).write_text(json.dumps(times, indent=0) + "\n", encoding="utf-8")
