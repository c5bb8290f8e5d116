"""The timing of a capture: which moment of the motion its images show at a time."""

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.io.safe_json_toml import parse_json

MOST_TIMES = 20_000  # that the header of a checkpoint has room for


@dataclass(frozen=True, eq=False)
class Timing:
    """The moment of the motion at each time of the clip, both in [0, 1]. Raises ValueError for others.

    times: (M,) float64, ascending. With none, each time is its own moment. moments: (M,) float64, never descending:
    those at these times. Between two times the difference changes evenly; outside of all it is that of the nearest.
    """

    times: NDArray[np.float64]
    moments: NDArray[np.float64]

    def __post_init__(self) -> None:
        for values in (self.times, self.moments):
            fits = values.shape == (self.times.size,) and values.dtype == np.float64
            if not (fits and ((values >= 0) & (values <= 1)).all() and (np.diff(values) >= 0).all()):
                raise ValueError("timing.times and .moments must be as many numbers from 0 to 1 that never descend")
        if not np.diff(self.times).all():
            raise ValueError("timing.times must be different")

    def __call__(self, t: float) -> float:
        """Return the moment at a time in [0, 1]; at others that of the nearest end. Raises ValueError for NaN."""
        if np.isnan(t):
            raise ValueError("a time must be a number, got NaN")
        later = float(np.interp(t, self.times, self.moments - self.times)) if len(self.times) else 0.0
        return min(max(t + later, 0.0), 1.0)

    def to_text(self) -> str:
        """JSON, which `timing_of_text` reads to the last bit."""
        return json.dumps({"times": self.times.tolist(), "moments": self.moments.tolist()})


EVEN = Timing(np.zeros(0), np.zeros(0))


def timing_of_text(text: str) -> Timing:
    """Return the timing that `to_text` wrote. Raises ValueError, or TypeError where the entries are no numbers."""
    table = parse_json(text, "its timing")
    if not isinstance(table, dict) or table.keys() != {"times", "moments"}:
        raise ValueError("timing is no table of times and moments")
    return Timing(**{name: np.array(values, np.float64) for name, values in table.items()})
