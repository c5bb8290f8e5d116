"""Commands that were recorded once and are submitted again: a dispatch then takes its host a few microseconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Recording:
    """What `Commands` did, in the native library's terms, and what has to be written anew before it is done again.

    It holds as long as no array that it uses was made anew (`Device.generation`).

    Attributes:
        constants: by pool and name the contents that others may write over.
        writers: write what varies.
        kept: objects whose native ones the commands use.
    """

    def __init__(self, generation: int) -> None:
        self.generation = generation
        self.commands: list[tuple[Any, ...]] = []
        self.constants: dict[tuple[Any, str], bytes] = {}
        self.writers: list[Callable[[], object]] = []
        self.kept: list[Any] = []
        self._varied: set[tuple[Any, str]] = set()
        self._varies = False

    def note(self, pool: Any, name: str, content: bytes) -> None:
        """A constant was written, which the commands use."""
        if self._varies:
            self._varied.add((pool, name))
            self.constants.pop((pool, name), None)
        elif (pool, name) not in self._varied:
            self.constants[pool, name] = content

    def vary(self, write: Callable[[], Any]) -> Any:
        """Call what writes a uniform now and before each replay."""
        self.writers.append(write)
        self._varies = True
        written = write()
        self._varies = False
        return written
