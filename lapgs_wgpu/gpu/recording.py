"""Commands that were recorded once and are submitted again: a dispatch then takes its host a few microseconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Recording:
    """What `Commands` did, in the native library's terms, and what has to be written anew before it is done again.

    It holds as long as no array that it uses was made anew (`Device.generation`).
    """

    def __init__(self, generation: int) -> None:
        self.generation = generation
        self.commands: list[tuple[Any, ...]] = []
        self.constants: list[tuple[Any, str, bytes]] = []  # of which pool, name, content: others may write over them
        self.writers: list[Callable[[], object]] = []
        self.kept: list[Any] = []  # objects whose native ones the commands use
