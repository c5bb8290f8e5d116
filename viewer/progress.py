"""One line on stderr that tells how far a long job is."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from types import TracebackType
from typing import TextIO

_TERMINAL_SECONDS = 0.25  # from one redraw of the line to the next
_FILE_SECONDS = 15.0  # the same where stderr is no terminal, and each is a line of its own


class Progress:
    """A context manager. what: the things counted, in the plural."""

    def __init__(self, total: int, what: str, terminal: TextIO | None = None) -> None:
        self._total, self._what, self._done = total, what, 0
        self._terminal = terminal or sys.stderr
        self._start = self._shown = time.perf_counter()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._terminal.isatty():
            self._tell("\n")

    def step(self) -> None:
        """One more is done."""
        self._done += 1
        now = time.perf_counter()
        on_terminal = self._terminal.isatty()
        last = self._done == self._total
        if last or now - self._shown >= (_TERMINAL_SECONDS if on_terminal else _FILE_SECONDS):
            self._shown = now
            minutes, seconds = divmod(round((now - self._start) / self._done * (self._total - self._done)), 60)
            text = f"{self._done}/{self._total} {self._what}  {minutes}:{seconds:02d} left"
            self._tell(f"\r\x1b[2K{text}" if on_terminal else f"{text}\n")

    def _tell(self, text: str) -> None:
        with suppress(OSError):  # nobody reads it any more, or it goes into a file on a full disk: no reason to stop
            self._terminal.write(text)
            self._terminal.flush()
