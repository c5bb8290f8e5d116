"""What the names of images say: which camera took each, and the clock times and seconds in them."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Words before the number in the name of a folder or file.
TIME_WORDS = {"frame", "fr", "time", "timestep", "timestamp", "ts", "t", "step", "moment", "sec"}
CAMERA_WORDS = {"cam", "camera", "c", "view", "kinect", "device"}
FILLED = 1.25  # of the images: cameras times their moments, where a fifth of these may lack an image
STILL = 0.02  # of the distance of cameras: the places of one that stands still are apart by less
_CLOCK = re.compile(  # 20260110_095848, 2026-01-10 at 9.58.48 PM, 09-58-48; digits after that are parts of a second
    r"(?<!\d)(?:(?P<date>(?:19|20)\d\d([-_.]?)\d\d\2\d\d)\D{0,4})?"
    r"(?P<hour>\d\d|(?<!\d)\d(?=[-_.:]))(?P<by>[-_.:]?)(?P<minute>\d\d)(?P=by)(?P<second>\d\d)"
    r"(?:[-_.]?(?P<part>\d{3}|\d{6}))?(?!\d)(?:\s?(?P<half>[AaPp])[Mm]\b)?"
)
_UNIX = re.compile(r"(?<!\d)(1\d{9})[-_.](\d{3,9})(?!\d)")
_DECIMAL = re.compile(r"(?:(?<![\w.])|(?<=[_-]))(\d+(?:\.(\d+))?)s?(?![\w.])")  # 0.25, t_0.25, 0.25s
_DAY = 86400.0  # seconds


class ImageName(NamedTuple):
    """file: relative path of an image, as in times.json. camera: the name of its folder, or of its file where folders
    are times. part: of the path, which states the time; empty where all of the file's name does."""

    file: str
    camera: str = ""
    part: str = ""

    @property
    def stamp(self) -> str:
        """The text that states the time."""
        return self.part or PurePosixPath(self.file).stem


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Sort key that puts cam2 before cam10."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts)


# Cameras


def image_names(files: Sequence[str], places: Mapping[str, NDArray[np.float64]]) -> list[ImageName]:
    """Tell cameras from times in relative paths: each folder is a camera (cam00/0001.png), or each is a time
    (frame000001/cam00.png), or names state both (cam00_0001.png).

    The words in the names decide; where they do not, whether cameras stand still in one of the two readings alone; else
    there are more times than cameras. places: (3,) of the cameras of some of the files.
    """
    parts = [(*(path := PurePosixPath(file)).parts[:-1], path.stem) for file in files]
    cameras = [ImageName(file, str(PurePosixPath(file).parent)) for file in files]
    same_depth = len(set(map(len, parts))) == 1
    varying = [level for level, names in enumerate(zip(*parts, strict=same_depth)) if len(set(names)) > 1]
    stem = len(parts[0]) - 1
    if not same_depth or len(varying) not in (1, 2):
        return cameras
    if varying == [stem]:
        return _named_by_both(files, places) or cameras
    outer, inner = varying[0], (*varying, stem)[1]

    def timed(level: int) -> list[ImageName]:
        """Take the folders of a level as times, and all others as cameras."""
        others = ["/".join(each[:level] + each[level + 1 :]) for each in parts]
        return [ImageName(*name) for name in zip(files, others, (each[level] for each in parts), strict=True)]

    readings = timed(outer), cameras if inner == stem else timed(inner)
    decided = _folders_are_times([each[outer] for each in parts], [each[inner] for each in parts])
    if decided is None:
        still = [stand_still(names, places) for names in readings]
        fewer = len({name.camera for name in readings[0]}) < len({name.camera for name in readings[1]})
        decided = still[0] if still[0] != still[1] else fewer
    return readings[0] if decided else readings[1]


def _named_by_both(files: Sequence[str], places: Mapping[str, NDArray[np.float64]]) -> list[ImageName] | None:
    """Take two varying words or numbers of the files' names as camera and time where cameras, so taken, stand apart and
    still, and most have an image at each time; else None."""
    rows = [re.findall(r"\d+|[^\W\d_]+", PurePosixPath(file).stem) for file in files]
    varying = [at for at, words in enumerate(zip(*rows)) if len(set(words)) > 1]  # noqa: B905
    apart = len(places) > 1 and extent(list(places.values())) > 0
    if len(set(map(len, rows))) > 1 or len(varying) != 2 or not apart:
        return None
    for camera, time in (varying, varying[::-1]):
        word = rows[0][camera - 1] if camera and rows[0][camera - 1].lower() in CAMERA_WORDS else ""
        names = [ImageName(file, word + row[camera], row[time]) for file, row in zip(files, rows, strict=True)]
        grid = len({name.camera for name in names}) * len({name.part for name in names})
        if grid <= FILLED * len(files) and stand_still(names, places):
            return names
    return None


def _folders_are_times(folders: Sequence[str], stems: Sequence[str]) -> bool | None:
    """Whether folders are times, or cameras, by their names and the files'; None where these do not say."""
    words, images = {_word(folder) for folder in folders}, Counter(stems)
    if len(words) != 1 or max(images.values()) < 2 or not all(re.search(r"\d", folder) for folder in folders):
        return False
    (word,), files = words, {_word(stem) for stem in stems}
    if word in CAMERA_WORDS or files & TIME_WORDS:
        return False
    if word in TIME_WORDS or not any(re.search(r"\d", stem) for stem in stems):
        return True
    if len(images) == 1:  # a folder for each image
        return False
    return True if word == "" and files <= CAMERA_WORDS else None


def _word(name: str) -> str:
    """The letters before the last number of a name."""
    return re.sub(r"[\W\d_]", "", re.sub(r"\d+\D*$", "", name)).lower()


def by_camera(names: Sequence[ImageName]) -> dict[str, list[int]]:
    """Return the indices of the images of each camera, by its name, in natural order."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.camera, []).append(index)
    return {camera: groups[camera] for camera in sorted(groups, key=natural_key)}


def extent(places: Sequence[NDArray[np.float64]]) -> float:
    """The largest side of the box around places (3,)."""
    return float(np.ptp(places, axis=0).max())


def stand_still(names: Iterable[ImageName], places: Mapping[str, NDArray[np.float64]]) -> bool:
    """Whether there are several cameras, each at about one place. places: (3,) of those of some of the files."""
    placed = [name for name in names if name.file in places]
    cameras = [[places[placed[i].file] for i in mine] for mine in by_camera(placed).values()]
    if len(cameras) < 2:
        return False
    apart = extent([place for own in cameras for place in own])
    return all(extent(own) <= STILL * apart for own in cameras)


# Times


def clock_times(names: Sequence[ImageName]) -> tuple[list[float], str] | None:
    """Return the times in seconds that all names state, and what they are; None if these are no clock times, Unix
    times or decimals, or if two images of a camera have the same."""
    matches = [match for name in names if (match := _CLOCK.search(name.stamp))]
    clocks = [clock for match in matches if (clock := _seconds(match)) is not None]
    dated = {match["date"] is not None for match in matches} if len(clocks) == len(names) else set()
    unix = [float(f"{found[1]}.{found[2]}") for name in names if (found := _UNIX.search(name.stamp))]
    readings = (
        (clocks if dated == {True} else None, "clock times"),
        (unix if len(unix) == len(names) else None, "Unix times"),
        (_times_of_day(names, matches, clocks) if dated == {False} else None, "clock times (HHMMSS)"),
        (_decimals([name.stamp for name in names]), "seconds"),
    )
    for seconds, kind in readings:
        if seconds and len({(name.camera, time) for name, time in zip(names, seconds, strict=True)}) == len(names) > 1:
            return seconds, kind
    return None


def _seconds(found: re.Match[str]) -> float | None:
    """Seconds of a match of _CLOCK, from its midnight where it has no date; None where it is no possible time."""
    hour, minute, second = (int(found[part]) for part in ("hour", "minute", "second"))
    if found["half"]:
        hour = hour % 12 + 12 * (found["half"] in "Pp")
    try:
        date = datetime.strptime(re.sub(r"\D", "", found["date"] or "19700101"), "%Y%m%d")
        clock = date.replace(hour=hour, minute=minute, second=second, tzinfo=UTC)
    except ValueError:  # 20261399_000001, 250000
        return None
    return clock.timestamp() + float(f"0.{found['part'] or 0}")


def _times_of_day(
    names: Sequence[ImageName], matches: Sequence[re.Match[str]], clocks: Sequence[float]
) -> list[float] | None:
    """Seconds of HHMMSS without a date, also past midnight; None unless they are alike in all else that the names of a
    camera hold, and more even as times than as numbers, which jump by 40 each minute."""
    around = {(name.camera, _CLOCK.sub("", name.stamp, count=1)) for name in names}
    if len(around) > len({name.camera for name in names}):
        return None
    ordered = np.sort(clocks)
    pauses = np.diff(ordered, prepend=ordered[0])
    evening = ordered[np.argmax(pauses)] if pauses.max() > _DAY / 2 else ordered[0]
    times = [clock if clock >= evening else clock + _DAY for clock in clocks]
    numbers = [float(re.sub(r"\D", "", match[0])) for match in matches]
    return times if _unevenness(times) < _unevenness(numbers) else None


def _unevenness(values: Sequence[float]) -> float:
    """The largest step between ascending values, in usual ones."""
    steps = np.diff(np.unique(values))
    return float(steps.max() / np.median(steps)) if len(steps) else 0.0


def _decimals(stamps: Sequence[str]) -> list[float] | None:
    """The decimal number of each stamp, if fractions differ in length and do not end in zeros, as no counters do."""
    rows = [list(_DECIMAL.finditer(stamp)) for stamp in stamps]
    if any(len(row) != 1 for row in rows):
        return None
    fractions = [row[0][2] or "" for row in rows]
    trailing = any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    if len({len(fraction) for fraction in fractions}) == 1 or trailing:
        whole = {row[0][1].split(".")[0] for row in rows}
        if len(whole) == 1 or min(map(len, fractions)) < 2:  # a version before a counter
            return None
    return [float(row[0][1]) for row in rows]
