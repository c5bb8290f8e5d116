"""Timestamps of own footage: from times.json or from the frame numbers in file names (docs/own-data.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.json_fields import number, read_json
from lapgs_wgpu.data.stamps import ImageName, clock_times
from lapgs_wgpu.errors import InputError

TIMES = "times.json"
APART = 0.05  # of the clip: cameras that begin or end further apart may have other rates or clocks
IN_STEP = 0.1  # of the time from an image of a camera to its next: less than films are off beside each other


def read_times(names: Sequence[ImageName], folder: Path) -> tuple[list[float], str]:
    """Read the time of each image, in any unit, and name the source of the times for errors.

    The source is times.json in the folder, if it exists, else clock times, seconds or frame numbers in the names.
    Raises InputError.
    """
    path = folder / TIMES
    if path.is_file():
        return _listed(names, path), str(path)
    whose = f"the names of folders in {folder}" if names[0].folder else f"the names of {folder}"
    if clocks := clock_times(names):
        times, kind = clocks
        return times, f"the {kind} in {whose}"
    return [float(number) for number in frame_numbers(names)], f"the frame numbers in {whose}"


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
    steps = [np.diff(np.unique(times[[c == camera for c in cameras]])) for camera in dict.fromkeys(cameras)]
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
    for camera in dict.fromkeys(name.camera for name in names):
        mine = [i for i, name in enumerate(names) if name.camera == camera]
        files = [names[i].file for i in mine]
        rows = [[int(digits) for digits in re.findall(r"\d+", names[i].stamp)] for i in mine]
        lengths = {len(row) for row in rows}
        if lengths == {0} or len(lengths) > 1:
            fewest = min(range(len(rows)), key=lambda i: len(rows[i]))
            most = max(range(len(rows)), key=lambda i: len(rows[i]))
            why = "it has no numbers"
            if rows[most]:
                why = f"{files[most]} has {len(rows[most])} numbers and it has {len(rows[fewest])}"
            raise InputError(
                f"the name {files[fewest]} does not state a frame number: {why}; write the times into {TIMES}, or "
                "number the frames."
            )
        varying = [column for column in range(len(rows[0])) if len({row[column] for row in rows}) > 1]
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
                raise InputError(f"{file} has the frame number {row[column]}, as {numbers[row[column]]} has.")
            numbers[row[column]] = file
    return [number_of[i] for i in range(len(names))]


def disorder(names: Sequence[ImageName], times: Sequence[float]) -> list[str]:
    """Warn about cameras whose times decrease with the frame number, and about cameras without a common time."""
    warnings = []
    spans: dict[str, tuple[float, float]] = {}
    for camera in dict.fromkeys(name.camera for name in names):
        mine = [(name, time) for name, time in zip(names, times, strict=True) if name.camera == camera]
        spans[camera] = min(time for _, time in mine), max(time for _, time in mine)
        if clock_times([name for name, _ in mine]):
            continue  # their numbers are no frame numbers
        try:
            numbers = frame_numbers([name for name, _ in mine])
        except InputError:
            continue  # names without a frame number have no order
        ordered = [entry for _, entry in sorted(zip(numbers, mine, strict=True), key=lambda pair: pair[0])]
        back = [(a, b) for a, b in pairwise(ordered) if b[1] < a[1]]
        if back:
            (first, at), (second, then) = back[0]
            warnings.append(
                f"frames are out of order: time goes back {len(back)} times in {len(ordered)} images, first from "
                f"{first.file} at {at:g} to {second.file} at {then:g}; check the times."
            )
    return warnings + _ends(spans, time_step(np.unique(np.array(times, np.float64))))


def _ends(spans: dict[str, tuple[float, float]], step: float) -> list[str]:
    """Warn about cameras without a common time, else about those that do not begin and end together."""
    warnings = []
    first_camera, *further = spans
    a, b = spans[first_camera]
    disjoint = [camera for camera in further if spans[camera][0] > b or spans[camera][1] < a]
    if disjoint:
        other = disjoint[0]
        c, d = spans[other]
        warnings.append(
            f"cameras film at different times: {first_camera} from {a:g} to {b:g} and {other} from {c:g} to {d:g}; "
            "if they filmed together, number their frames from a common time on."
        )
        return warnings
    for word, ends in (("begin", [low for low, _ in spans.values()]), ("end", [high for _, high in spans.values()])):
        length = max(high for _, high in spans.values()) - min(low for low, _ in spans.values())
        if max(ends) - min(ends) > max(1.5 * step, APART * length):
            at: dict[float, list[str]] = {}
            for camera, end in zip(spans, ends, strict=True):
                at.setdefault(end, []).append(camera)
            told = ", ".join(
                f"{', '.join(cameras[:4])}{' ...' * (len(cameras) > 4)} at {end:g}" for end, cameras in at.items()
            )
            warnings.append(
                f"cameras {word} at different times: {told}; if some film more images a second, or were started apart, "
                f"write the times in seconds into {TIMES}."
            )
    return warnings


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Sort key that puts cam2 before cam10."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts)


def write_times(folder: Path, times: dict[str, float]) -> None:
    """Write times.json. times: of each image in seconds, by its path below images/."""
    (folder / TIMES).write_text(json.dumps(times, indent=0) + "\n", encoding="utf-8")
