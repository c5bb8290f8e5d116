"""Timestamps of own footage, from times.json or from the names of images, and what is held out (docs/own-data.md)."""

import re
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.evenly import some
from lapgs_wgpu.data.json_fields import FINITE, number, read_json
from lapgs_wgpu.data.stamps import STILL, ImageName, by_camera, clock_times, extent, natural_key
from lapgs_wgpu.errors import InputError

TIMES = "times.json"
APART = 0.05  # of the clip: cameras that begin or end further apart may have other rates or clocks
EVERY = 8  # one of so many times is tested: the fifth, the thirteenth, ...
FIRST = 4
CAMERAS = 3  # with so many cameras or more, the first camera is held out instead
IN_STEP = 0.1  # of the time from an image of a camera to its next: less than films are off beside each other


def read_times(names: Sequence[ImageName], folder: Path) -> tuple[list[float], str]:
    """Read the time of each image, in any unit, and name their source for errors: times.json in the folder, if it
    exists, else clock times, seconds or frame numbers in the names. Raises InputError."""
    path = folder / TIMES
    if not path.is_file():
        clocks = clock_times(names)
        times, kind = clocks or ([float(number) for number in frame_numbers(names)], "frame numbers")
        return times, f"the {kind} in the names of {folder}"
    stated = read_json(path).values
    listed = [file if (file := name.file) in stated else file.removeprefix("images/") for name in names]
    missing = [file for file in listed if file not in stated]
    if missing:
        example = f", such as {next(iter(stated))[:80]}" if stated else ""
        raise InputError(
            f"{path} has {len(stated)} times{example}, but none for {len(missing)} of {len(names)} images, such "
            f"as {missing[0]}; name each image by its path below images/."
        )
    return [number(stated[file], f"the time of {file}", path, *FINITE) for file in listed], str(path)


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


def as_one_camera(
    names: Sequence[ImageName], times: Sequence[float], places: Sequence[NDArray[np.float64]]
) -> list[ImageName]:
    """Give the images of several folders to one camera if it moves in each, and they follow one another in time.
    places: (3,) of the camera of each image."""
    groups = list(by_camera(names).values())
    spans = sorted((min(times[i] for i in mine), max(times[i] for i in mine)) for mine in groups)
    follow = all(after[0] > before[1] for before, after in pairwise(spans))
    least = STILL * extent(places)
    moving = all(extent([places[i] for i in mine]) > least for mine in groups)
    one = len(groups) > 1 and follow and moving
    return [name._replace(camera="") for name in names] if one else list(names)


def frame_numbers(names: Sequence[ImageName]) -> list[int]:
    """Return the frame number in each file name: the only number that differs between the images of a camera. Raises
    InputError if there is none, or more than one."""
    found = [0] * len(names)
    for mine in by_camera(names).values():
        files = [names[i].file for i in mine]
        rows = [[int(digits) for digits in re.findall(r"\d+", names[i].stamp)] for i in mine]
        counts = sorted((len(row), file) for row, file in zip(rows, files, strict=True))
        (fewest, one), (most, other) = counts[0], counts[-1]
        if not fewest or fewest < most:
            raise InputError(
                f"{one} has {fewest} numbers in its name and {other} has {most}, so which is the frame's is "
                f"not clear; write the times into {TIMES}, or number the frames."
            )
        columns = list(zip(*rows, strict=True))
        varying = [column for column in columns if len(set(column)) > 1]
        if len(varying) > 1:  # a counter beside a clock of seconds, which repeats itself
            once = [column for column in varying if len(set(column)) == len(column)]
            if len(once) == 1 and all(x <= y for a, b in pairwise(sorted(rows)) for x, y in zip(a, b, strict=True)):
                varying = once
        if len(varying) > 1:
            raise InputError(
                f"{files[0]} and {files[-1]} differ in {len(varying)} numbers, so the frame number is ambiguous; write "
                f"the times into {TIMES}, or put the images of each camera into a folder of their own."
            )
        first: dict[int, str] = {}
        for i, file, frame in zip(mine, files, varying[0] if varying else columns[-1], strict=True):
            found[i] = frame
            if (before := first.setdefault(frame, file)) != file:
                raise InputError(
                    f"{file} has the frame number {frame}, as {before} has; rename one, or give each camera a folder."
                )
    return found


def disorder(names: Sequence[ImageName], times: Sequence[float]) -> list[str]:
    """Warn about cameras whose times decrease with the frame number, and about cameras that do not film together."""
    warnings = []
    cameras = by_camera(names)
    for mine in cameras.values():
        own = [names[i] for i in mine]
        if clock_times(own):
            continue
        with suppress(InputError):  # names without a frame number have no order
            ordered = [i for _, i in sorted(zip(frame_numbers(own), mine, strict=True))]
            back = [(a, b) for a, b in pairwise(ordered) if times[b] < times[a]]
            if back:
                first, second = back[0]
                warnings.append(
                    f"frames are out of order: time goes back {len(back)} times in {len(ordered)} images, first from "
                    f"{names[first].file} at {times[first]:g} to {names[second].file} at {times[second]:g}; correct "
                    "the times, or the numbers."
                )
    spans = {camera: (min(times[i] for i in mine), max(times[i] for i in mine)) for camera, mine in cameras.items()}
    step = max(time_step(np.unique([times[i] for i in mine])) for mine in cameras.values())
    longest = max(1.5 * step, APART * (max(times) - min(times)))
    if any(max(ends) - min(ends) > longest for ends in zip(*spans.values(), strict=True)):
        alike = dict[tuple[float, float], list[str]]()
        for camera, span in spans.items():
            alike.setdefault(span, []).append(camera)
        told = (f"{some(cameras)} from {a:g} to {b:g}" for (a, b), cameras in alike.items())
        warnings.append(
            f"cameras film at different times: {', '.join(told)}; if these are no seconds, since some film more images "
            f"a second or were started apart, write the times in seconds into {TIMES}."
        )
    return warnings


def held_out(names: Sequence[ImageName], times: Sequence[float]) -> set[int]:
    """Return the indices of the test images: those of the first camera, if there are three or more cameras; else those
    of every eighth time, from the fifth on. Raises InputError if there are too few."""
    cameras = sorted({name.camera for name in names}, key=natural_key)
    if len(cameras) >= CAMERAS:
        return {i for i, name in enumerate(names) if name.camera == cameras[0]}
    distinct = sorted(set(times))
    moments = times if len(distinct) > 1 else range(len(names))  # of equal times, each image counts as one of its own
    tested = set(sorted(set(moments))[FIRST::EVERY])
    chosen = {i for i, moment in enumerate(moments) if moment in tested}
    if not chosen:
        raise InputError(
            f"{len(names)} images at {len(distinct)} times are too few: every eighth time from the fifth on is held "
            "out for testing, so at least 5 are needed, or 3 cameras, of which the first is held out."
        )
    return chosen
