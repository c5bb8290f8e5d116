"""Waiting for what other programs do, on a machine that may do much else."""

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE = 120.0  # seconds
Found = TypeVar("Found")


def wait_for(look: Callable[[], Found], what: str, seconds: float = PATIENCE) -> Found:
    """The first true value that `look` returns; fails after that many seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = look()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError(f"{what}: not within {seconds:g} seconds")
