"""Buffer capacities of an image, predicted from earlier images."""

import math
from dataclasses import dataclass, replace

_WATCHED = 256  # drawings of one kind, after which a plan that is too large for all of them shrinks


@dataclass(frozen=True)
class BufferPlan:
    """Buffer capacities of an image. Only the number of bands changes the result, in the last bits of gradients.

    capacity: maximum number of intersections (tile, splat). bands: number of bands of tile rows, which are drawn one
    after another. rounds: number of dispatches that draw the tiles' lists.
    """

    capacity: int
    bands: int = 1
    rounds: int = 1


def roomy(intersections: int) -> int:
    """Return a capacity with room for a quarter more intersections."""
    return (5 * intersections // 4 + 4095) // 4096 * 4096


# A kind of images: width and height in pixels, and whether their gradients are wanted.
Kind = tuple[int, int, bool]


class BufferPlans:
    """The plan of each kind of images. The cost of a pass grows with the capacity, so small images have plans of their
    own. The number of bands decides the order in which gradients are added, so images without gradients must not
    raise it.

    now: the plan of the kind that is drawn. capacity: of the first one.
    """

    def __init__(self, capacity: int) -> None:
        self.now = BufferPlan(capacity)
        self._first_capacity = capacity
        self._kind: Kind | None = None
        self._others: dict[Kind, BufferPlan] = {}
        self._watched, self._most = 0, 0  # drawings by this plan, and the most intersections of a band

    def turn_to(self, kind: Kind) -> None:
        """Make the plan of this kind of images the current one."""
        if self._kind is not None and self._kind != kind:
            self._others[self._kind] = self.now
            # Small splats lie on one tile at any size, large ones on as many more as there are pixels.
            share = math.sqrt(math.prod(kind[:2]) / math.prod(self._kind[:2]))
            guess = min(self.now.capacity, max(self._first_capacity, round(share * self.now.capacity)))
            self.now = self._others.pop(kind, BufferPlan(guess))
            self._watched = self._most = 0
        self._kind = kind

    def bands(self, kind: Kind) -> int:
        """Return the number of bands of images of this kind."""
        return self.now.bands if kind == self._kind else self._others.get(kind, BufferPlan(0)).bands

    def set_bands(self, kind: Kind, bands: int) -> None:
        """Make the plan of this kind of images the current one, with this number of bands."""
        self.turn_to(kind)
        self.now = replace(self.now, bands=bands)

    def fitted(self, most: int) -> None:
        """Record that an image fitted, with at most `most` intersections in a band. After _WATCHED images this shrinks
        a plan that was too large for all of them.

        Bands stay, and a training's state holds their number, on which its bits depend.
        """
        self._watched, self._most = self._watched + 1, max(self._most, most)
        if self._watched < _WATCHED:
            return
        capacity, enough = self.now.capacity, roomy(self._most)
        # Half of the rounds may be too few; then one image is drawn twice.
        rounds = max(1, self.now.rounds // 2)
        self.now = replace(self.now, capacity=enough if 2 * enough <= capacity else capacity, rounds=rounds)
        self._watched = self._most = 0
