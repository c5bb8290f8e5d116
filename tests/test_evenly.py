"""Some of many, evenly chosen."""

from __future__ import annotations

import pytest

from lapgs_wgpu.data.evenly import evenly


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
