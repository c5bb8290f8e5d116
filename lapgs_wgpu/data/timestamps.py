"""Timestamps of own footage: from times.json or from the names of images (docs/own-data.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.json_fields import number, read_json
from lapgs_wgpu.data.stamps import STILL, ImageName, clock_times, natural_key
from lapgs_wgpu.errors import InputError

TIMES = "times.json"
APART = 0.05  # of the clip: cameras that begin or end further apart may have other rates or clocks
IN_STEP = 0.1  # of the time from an image of a camera to its next: less than films are off beside each other
FEW = 5  # images of a camera, from which on a multiple of them tells another rate


def read_times(names: Sequence[ImageName], folder: Path, warnings: list[str]) -> tuple[list[float], str]:
    """Read the time of each image, in any unit, and name the source of the times for errors.

    The source is times.json in the folder, if it exists, else clock times, seconds or frame numbers in the names.
    Appends warnings about cameras of another rate. Raises InputError.
    """
    path = folder / TIMES
    if path.is_file():
        return _listed(names, path), str(path)
    whose = f"the names of folders in {folder}" if names[0].timed_folder else f"the names of {folder}"
    if clocks := clock_times(names):
        times, kind = clocks
        return times, f"the {kind} in {whose}"
    numbers = frame_numbers(names)
    return _at_one_rate(names, numbers, warnings), f"the frame numbers in {whose}"


def to_unit_range(values: Sequence[float], first: float, last: float) -> list[float]:
    """Scale times so that `first` becomes 0 and `last` 1; all become 0 if the two are equal."""
    return [(value - first) / (last - first) if last > first else 0.0 for value in values]


def time_step(times: NDArray[np.float64]) -> float:
    """The usual difference of ascending times (T,); 1 for a single one."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 1.0


def in_step(names: Sequence[ImageName], values: Sequence[float]) -> list[float]:
    """Times, in any unit, in which images of different cameras have one time if they differ by less than IN_STEP of the
    time from an image of a camera to its next: their mean. Films start at times of their own, and keep time roughly."""
    cameras = [name.camera for name in names]
    times = np.array(values, np.float64)
    steps = [np.diff(np.unique(times[indices])) for indices in by_camera(names).values()]
    if len(steps) < 2 or not len(np.concatenate(steps)):
        return list(values)
    closest = IN_STEP * float(np.median(np.concatenate(steps)))
    groups: list[list[int]] = []
    for i in np.argsort(times, kind="stable").tolist():
        group = groups[-1] if groups else []
        if group and times[i] - times[group[0]] < closest and cameras[i] not in {cameras[j] for j in group}:
            group.append(i)
        else:
            groups.append([i])
    for group in groups:
        times[group] = times[group[0]] + np.mean(times[group] - times[group[0]])
    return times.tolist()


def by_camera(names: Sequence[ImageName]) -> dict[str, list[int]]:
    """Return the indices of the images of each camera, by its name, in natural order."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.camera, []).append(index)
    return {camera: groups[camera] for camera in sorted(groups, key=natural_key)}


def as_one_camera(
    names: Sequence[ImageName], times: Sequence[float], places: Sequence[NDArray[np.float64]]
) -> list[ImageName]:
    """Give the images of several folders to one camera if it moves in each, and they follow one another in time.

    places: (3,) of the camera of each image.
    """
    groups = list(by_camera(names).values())
    spans = sorted((min(times[i] for i in mine), max(times[i] for i in mine)) for mine in groups)
    follow = all(after[0] > before[1] for before, after in pairwise(spans))
    least = STILL * float(np.ptp(places, axis=0).max())
    moving = all(float(np.ptp([places[i] for i in mine], axis=0).max()) > least for mine in groups)
    one = len(groups) > 1 and follow and moving
    return [name._replace(camera="") for name in names] if one else list(names)


def _listed(names: Sequence[ImageName], path: Path) -> list[float]:
    times = read_json(path).values
    listed = [file if (file := name.file) in times else file.removeprefix("images/") for name in names]
    missing = [file for file in listed if file not in times]
    if missing:
        example = f", such as {next(iter(times))[:80]}" if times else ""
        raise InputError(
            f"{path} has {len(times)} times{example}, but none for {len(missing)} of {len(names)} images, such "
            f"as {missing[0]}; name each image by its path below images/."
        )
    return [number(times[file], f"the time of {file}", path) for file in listed]


def frame_numbers(names: Sequence[ImageName]) -> list[int]:
    """Return the frame number in each file name: the only number that differs between the images of a camera.

    Raises InputError if no number differs, or more than one.
    """
    number_of: dict[int, int] = {}
    for mine in by_camera(names).values():
        files = [names[i].file for i in mine]
        rows = [[int(digits) for digits in re.findall(r"\d+", names[i].stamp)] for i in mine]
        fewest, most = (choose(range(len(rows)), key=lambda i: len(rows[i])) for choose in (min, max))
        if not rows[fewest] or len(rows[fewest]) < len(rows[most]):
            other = f"it has {len(rows[fewest])} and {files[most]} has {len(rows[most])}"
            raise InputError(
                f"the name {files[fewest]} does not state a frame number: "
                f"{other if rows[most] else 'it has no numbers'}; write the times into {TIMES}, or number the frames."
            )
        varying = [column for column in range(len(rows[0])) if len({row[column] for row in rows}) > 1]
        if len(varying) > 1:  # a counter beside a clock of seconds, which repeats itself
            ordered = sorted(rows, key=lambda row: [row[column] for column in reversed(varying)])
            once = [column for column in varying if len({row[column] for row in rows}) == len(rows)]
            if len(once) == 1 and all(a[c] <= b[c] for a, b in pairwise(ordered) for c in varying):
                varying = once
        if len(varying) > 1:
            raise InputError(
                f"{files[0]} and {files[-1]} differ in {len(varying)} numbers, so the frame number is ambiguous; write "
                f"the times into {TIMES}, or put the images of each camera into a folder of their own."
            )
        column = varying[0] if varying else len(rows[0]) - 1
        numbers: dict[int, str] = {}
        for i, file, row in zip(mine, files, rows, strict=True):
            number_of[i] = row[column]
            if row[column] in numbers:
                raise InputError(
                    f"{file} has the frame number {row[column]}, as {numbers[row[column]]} has; rename one, or "
                    "put the images of each camera into a folder of their own."
                )
            numbers[row[column]] = file
    return [number_of[i] for i in range(len(names))]


def _at_one_rate(names: Sequence[ImageName], numbers: Sequence[int], warnings: list[str]) -> list[float]:
    """Times of frame numbers, in those of the slowest camera: one with twice as many images films at twice the rate.

    This holds where all cameras begin at one number and have exact multiples of as many images. Appends a warning.
    """
    cameras = by_camera(names)
    spans = {camera: sorted(numbers[i] for i in mine) for camera, mine in cameras.items()}
    least = min(map(len, spans.values()))
    first = min(span[0] for span in spans.values())
    if (
        least < FEW
        or len(set(map(len, spans.values()))) == 1
        or any(len(span) % least or span != list(range(first, first + len(span))) for span in spans.values())
    ):
        return [float(number) for number in numbers]
    rates = {camera: len(span) // least for camera, span in spans.items()}
    warnings += _ends({camera: (float(span[0]), float(span[-1])) for camera, span in spans.items()}, 1.0, "")
    faster = [f"{camera} has {rate} times as many images" for camera, rate in rates.items() if rate > 1]
    warnings.append(
        f"cameras have other rates: {', '.join(faster)} as the slowest, and is taken to film as many times as fast, "
        f"over the same time; if it filmed longer, write the times in seconds into {TIMES}."
    )
    return [first + (number - first) / rates[name.camera] for name, number in zip(names, numbers, strict=True)]


def disorder(names: Sequence[ImageName], times: Sequence[float], *, numbered: bool) -> list[str]:
    """Warn about cameras whose times decrease with the frame number, and about cameras without a common time.

    numbered: whether the times are frame numbers.
    """
    warnings = []
    spans: dict[str, tuple[float, float]] = {}
    for camera, mine in by_camera(names).items():
        own = [names[i] for i in mine]
        spans[camera] = min(times[i] for i in mine), max(times[i] for i in mine)
        if clock_times(own):
            continue  # their numbers are no frame numbers
        try:
            numbers = frame_numbers(own)
        except InputError:
            continue  # names without a frame number have no order
        ordered = [i for _, i in sorted(zip(numbers, mine, strict=True))]
        back = [(a, b) for a, b in pairwise(ordered) if times[b] < times[a]]
        if back:
            first, second = back[0]
            warnings.append(
                f"frames are out of order: time goes back {len(back)} times in {len(ordered)} images, first from "
                f"{names[first].file} at {times[first]:g} to "
                f"{names[second].file} at {times[second]:g}; correct the times, or the numbers."
            )
    advice = f"; if some film more images a second, or were started apart, write the times in seconds into {TIMES}"
    slowest = max(time_step(np.unique([times[i] for i in mine])) for mine in by_camera(names).values())
    return warnings + _ends(spans, slowest, advice if numbered else "")


def _ends(spans: dict[str, tuple[float, float]], step: float, advice: str) -> list[str]:
    """Warn about cameras without a common time, else about those that do not begin and end together."""
    warnings = []
    first_camera, *further = spans
    a, b = spans[first_camera]
    disjoint = [camera for camera in further if spans[camera][0] > b or spans[camera][1] < a]
    if disjoint:
        other = disjoint[0]
        c, d = spans[other]
        return [
            f"cameras film at different times: {first_camera} from {a:g} to {b:g} and {other} from {c:g} to {d:g}; "
            "if they filmed together, give their times, or numbers, from a common moment on."
        ]
    for word, ends in (("begin", [low for low, _ in spans.values()]), ("end", [high for _, high in spans.values()])):
        length = max(high for _, high in spans.values()) - min(low for low, _ in spans.values())
        if max(ends) - min(ends) > max(1.5 * step, APART * length):
            at: dict[float, list[str]] = {}
            for camera, end in zip(spans, ends, strict=True):
                at.setdefault(end, []).append(camera)
            told = ", ".join(
                f"{', '.join(cameras[:4])}{' ...' * (len(cameras) > 4)} at {end:g}" for end, cameras in at.items()
            )
            warnings.append(f"cameras {word} at different times: {told}{advice}.")
    return warnings


def write_times(folder: Path, times: dict[str, float]) -> None:
    """Write times.json. times: of each image in seconds, by its path below images/."""
    (folder / TIMES).write_text(json.dumps(times, indent=0) + "\n", encoding="utf-8")
