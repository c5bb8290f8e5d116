"""Some of many: evenly chosen items, the first names of a list."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
NAMED = 5  # names in a warning


def evenly(items: Sequence[T], most: int) -> list[T]:
    """At most `most` of the items, in their order, evenly spaced; the first and the last are among them."""
    return [items[i] for i in evenly_indices(len(items), most).tolist()]


def evenly_indices(count: int, most: int) -> NDArray[np.int64]:
    """Ascending indices of at most `most` of `count` items, evenly spaced; the first and the last are among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def some(names: Sequence[str]) -> str:
    """The first of the names of a warning, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
