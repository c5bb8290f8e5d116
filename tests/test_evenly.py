"""Some of many, evenly chosen."""

from __future__ import annotations

import pytest

from lapgs_wgpu.data.evenly import evenly, evenly_indices


@pytest.mark.parametrize(("count", "most", "chosen"), [
    (5, 9, [0, 1, 2, 3, 4]),
    (5, 5, [0, 1, 2, 3, 4]),
    (9, 3, [0, 4, 8]),
    (10, 4, [0, 3, 6, 9]),
    (1, 3, [0]),
    (3, 1, [0]),
    (0, 3, []),
])  # fmt: skip
def test_they_are_spread_from_the_first_to_the_last(count: int, most: int, chosen: list[int]) -> None:
    assert evenly(range(count), most) == chosen


def test_indices_ascend() -> None:
    for count in range(40):
        for most in range(1, count + 2):
            indices = evenly_indices(count, most)
            assert len(indices) == min(count, most)
            assert (indices[1:] > indices[:-1]).all()
