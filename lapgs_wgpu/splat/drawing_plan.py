"""How much room an image is drawn with, by the images before it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

_WATCHED = 256  # drawings of one size, after which a plan that is too large for all of them shrinks
_SIZES = 32  # of images, whose plans are kept


@dataclass(frozen=True)
class Plan:
    """How an image is drawn. The plan does not change the result.

    capacity: maximum number of intersections (tile, splat). bands: number of bands of tile rows, which are drawn one
    after another. rounds: number of dispatches that draw the tiles' lists.
    """

    capacity: int
    bands: int = 1
    rounds: int = 1


def roomy(intersections: int) -> int:
    """A capacity with room for a quarter more."""
    return (5 * intersections // 4 + 4095) // 4096 * 4096


class Plans:
    """The plan of each size of images: passes cost as much as there is room, so small images need one of their own.

    now: the plan of the size that is drawn. capacity: of the first one.
    """

    def __init__(self, capacity: int) -> None:
        self.now = Plan(capacity)
        self._first_capacity = capacity
        self._size: tuple[int, int] | None = None
        self._others: dict[tuple[int, int], Plan] = {}  # by size, the latest last
        self._watched, self._most = 0, 0  # drawings by this plan, and the most intersections of a band

    def turn_to(self, size: tuple[int, int]) -> None:
        """Images of this size, (width, height), come next."""
        if self._size is not None and self._size != size:
            self._others[self._size] = self.now
            # Small splats lie on one tile at any size, large ones on as many more as there are pixels.
            share = math.sqrt(math.prod(size) / math.prod(self._size))
            guess = min(self.now.capacity, max(self._first_capacity, round(share * self.now.capacity)))
            self.now = self._others.pop(size, Plan(guess))
            if len(self._others) > _SIZES:
                self._others.pop(next(iter(self._others)))
            self._watched = self._most = 0
        self._size = size

    def fitted(self, most: int) -> None:
        """An image fitted, with at most so many intersections in a band. From time to time this shrinks a plan that was
        too large for all.

        Bands stay: their number decides in which order gradients are added, and so must not depend on what came before
        more than it has to.
        """
        self._watched, self._most = self._watched + 1, max(self._most, most)
        if self._watched < _WATCHED:
            return
        capacity = self.now.capacity
        if 2 * roomy(self._most) <= capacity:
            capacity = roomy(self._most)
        # Half of the rounds may be too few; then one image is drawn twice.
        self.now = replace(self.now, capacity=capacity, rounds=max(1, self.now.rounds // 2))
        self._watched = self._most = 0
