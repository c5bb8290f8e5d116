"""The progress line of a long job, on stderr."""

import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Self, TextIO, TypeVar

T = TypeVar("T")
TERMINAL_SECONDS = 0.25  # between two updates of the line on a terminal
FILE_SECONDS = 15.0  # between two lines where stderr is no terminal


class Progress:
    """A context manager. total: number of steps. what: the steps' name, in the plural. stream: stderr where None."""

    def __init__(self, total: int, what: str, stream: TextIO | None = None) -> None:
        self._total, self._what = total, what
        self._stream = stream or sys.stderr
        self._shown = time.perf_counter()
        self._first: tuple[int, float] | None = None  # step, and when it was done: what comes before it may take long

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream.isatty():
            self._write("\n")

    def at(self, done: int, text: Callable[[], str] | None = None) -> None:
        """`done` steps are done. text: makes the line, by default the count and the time left at the mean rate since
        the first call."""
        now = time.perf_counter()
        self._first = first, since = self._first or (done, now)
        if done == self._total or self.due:
            self._shown = now
            line = text() if text else f"{done}/{self._total} {self._what}"
            if not text and done != first:
                line += f"  {duration((now - since) / (done - first) * (self._total - done))} left"
            width = shutil.get_terminal_size().columns - 1  # older consoles know no escape codes
            self._write(f"\r{line[:width]:<{width}}" if self._stream.isatty() else f"{line}\n")

    @property
    def due(self) -> bool:
        """Whether it is time to show the line again."""
        seconds = TERMINAL_SECONDS if self._stream.isatty() else FILE_SECONDS
        return time.perf_counter() - self._shown >= seconds

    def note(self, text: str) -> None:
        """Print a line of its own."""
        self.clear()
        self._write(f"{text}\n")

    def clear(self) -> None:
        """Remove the line from a terminal."""
        if self._stream.isatty():
            self._write(f"\r{' ' * (shutil.get_terminal_size().columns - 1)}\r")

    def _write(self, text: str) -> None:
        with suppress(OSError):  # a closed pipe or a full disk behind stderr does not stop the job
            self._stream.write(text)
            self._stream.flush()


def counted(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    """The items, each a step of a Progress once it was worked on."""
    with Progress(total, what) as progress:
        for done, item in enumerate(items, 1):
            yield item
            progress.at(done)


def say(text: str) -> None:
    """Print a line on stdout, if somebody still reads it: a closed pipe does not stop a long job."""
    with suppress(OSError):
        print(text, flush=True)


def duration(seconds: float) -> str:
    """m:ss, or h:mm:ss from an hour on."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
