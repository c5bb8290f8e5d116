"""What the names of images say: which camera took each, and the clock times and seconds in them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import NamedTuple

# Words before the number in the name of a folder or file.
TIME_WORDS = {"frame", "fr", "time", "timestep", "timestamp", "ts", "t", "step", "moment", "sec"}
CAMERA_WORDS = {"cam", "camera", "c", "view", "kinect", "device"}
_CLOCK = re.compile(  # 20260110_095848, 2026-01-10 at 09.58.48; digits after that are a fraction of a second
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)\D{0,4}(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d)(?:[-_.]?(\d{3}|\d{6}))?(?!\d)"
)
_UNIX = re.compile(r"(?<!\d)(1\d{9})[-_.](\d{3,9})(?!\d)")
_DECIMAL = re.compile(r"(?<![\w.])\d+(?:\.(\d+))?(?![\w.])|(?<=[_-])\d+(?:\.(\d+))?(?![\w.])")


class ImageName(NamedTuple):
    """file: relative path of an image, as in times.json. camera: the camera that took it, the name of its folder, or of
    its file where the folders are times. folder: that states the time; empty where the file's name does."""

    file: str
    camera: str = ""
    folder: str = ""

    @property
    def stamp(self) -> str:
        """The text that states the time."""
        return self.folder or PurePosixPath(self.file).stem


def image_names(files: Sequence[str]) -> list[ImageName]:
    """Tell cameras from times in relative paths: each folder is a camera (cam00/0001.png), or each is a time
    (frame000001/cam00.png), by the words in the names."""
    paths = [PurePosixPath(file) for file in files]
    level = _varying_folder([path.parts[:-1] for path in paths])
    if level is None or not _folders_are_times([path.parts[level] for path in paths], paths):
        return [ImageName(file, str(path.parent)) for file, path in zip(files, paths, strict=True)]
    named = []
    for file, path in zip(files, paths, strict=True):
        rest = PurePosixPath(*path.parts[level + 1 :]).with_suffix("")
        named.append(ImageName(file, str(rest), path.parts[level]))
    return named


def _varying_folder(parents: Sequence[tuple[str, ...]]) -> int | None:
    """The only level at which the folders of images differ; None if there is none, or more than one."""
    if len({len(parts) for parts in parents}) != 1:
        return None
    varying = [level for level, parts in enumerate(zip(*parents, strict=True)) if len(set(parts)) > 1]
    return varying[0] if len(varying) == 1 else None


def _folders_are_times(folders: Sequence[str], paths: Sequence[PurePosixPath]) -> bool:
    words, stems = {_word(folder) for folder in folders}, [path.stem for path in paths]
    images = Counter(stems)
    if len(words) != 1 or max(images.values()) < 2 or not all(re.search(r"\d", folder) for folder in folders):
        return False
    (word,) = words
    files = {_word(stem) for stem in stems}
    if len(images) == 1:  # a folder for each image
        return word in TIME_WORDS or (word == "" and not re.search(r"\d", stems[0]))
    if word in TIME_WORDS:
        return not files & TIME_WORDS
    return word == "" and files <= CAMERA_WORDS


def _word(name: str) -> str:
    """The letters before the last number of a name."""
    return re.sub(r"[\W\d_]", "", re.sub(r"\d+\D*$", "", name)).lower()


def clock_times(names: Sequence[ImageName]) -> tuple[list[float], str] | None:
    """Return the times in seconds that all names state, and what they are; None if these are no clock times, Unix
    times or decimals, or if two images of a camera have the same.
    """
    stamps = [name.stamp for name in names]
    for read, kind in ((_clock_seconds, "clock times"), (_unix_seconds, "Unix times")):
        read_times = [read(stamp) for stamp in stamps]
        seconds = [value for value in read_times if value is not None]
        if len(seconds) == len(names) and _differ(names, seconds):
            return seconds, kind
    decimals = _decimals(stamps)
    return (decimals, "seconds") if decimals and _differ(names, decimals) else None


def _differ(names: Sequence[ImageName], times: Sequence[float]) -> bool:
    return len({(name.camera, time) for name, time in zip(names, times, strict=True)}) == len(names) > 1


def _clock_seconds(stamp: str) -> float | None:
    if not (found := _CLOCK.search(stamp)):
        return None
    *date, fraction = found.groups()
    try:
        clock = datetime.strptime("".join(date), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    except ValueError:  # 20261399_000001
        return None
    return clock.timestamp() + float(f"0.{fraction or 0}")


def _unix_seconds(stamp: str) -> float | None:
    found = _UNIX.search(stamp)
    return float(f"{found[1]}.{found[2]}") if found else None


def _decimals(stamps: Sequence[str]) -> list[float] | None:
    """The decimal number of each stamp, if fractions differ in length and do not end in zeros, as no counters do."""
    rows = [list(_DECIMAL.finditer(stamp)) for stamp in stamps]
    if any(len(row) != 1 for row in rows):
        return None
    fractions = [row[0][1] or row[0][2] or "" for row in rows]
    trailing = any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    if len({len(fraction) for fraction in fractions}) == 1 or trailing:
        whole = {row[0][0].split(".")[0] for row in rows}
        if len(whole) == 1 or min(map(len, fractions)) < 2:  # a version before a counter
            return None
    return [float(row[0][0]) for row in rows]
