"""Initial points and scales."""

from __future__ import annotations

import numpy as np
import pytest

from lapgs_wgpu.data.init import MIN_SCALE, initial_scales, random_points


def test_random_points() -> None:
    means, colours = random_points(5000, -1.3, 1.3, 0)
    assert means.dtype == colours.dtype == np.float32
    assert means.shape == colours.shape == (5000, 3)
    assert -1.3 <= means.min() < -1.29
    assert 1.29 < means.max() <= 1.3
    np.testing.assert_allclose(means.mean(axis=0), 0, atol=0.05)
    np.testing.assert_array_equal(colours, np.float32(0.5))
    np.testing.assert_array_equal(means, random_points(5000, -1.3, 1.3, 0)[0])
    assert (means != random_points(5000, -1.3, 1.3, 1)[0]).any()


def test_scales_match_all_pairs() -> None:
    points, _ = random_points(200, -1.0, 2.0, 3)
    squared = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=-1)
    expected = np.sqrt(np.sort(squared, axis=1)[:, 1:4].mean(axis=1))
    scales = initial_scales(points)
    assert scales.dtype == np.float32
    np.testing.assert_allclose(scales, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("points", "scales"),
    [
        ([[5, 5, 5]], [1]),
        ([[0, 0, 0], [3, 4, 0]], [5, 5]),
        ([[0, 0, 0], [1, 0, 0], [3, 0, 0]], [np.sqrt(5), np.sqrt(2.5), np.sqrt(6.5)]),
        ([[1, 2, 3]] * 7, [MIN_SCALE] * 7),
        ([[0, 0, 0]] * 2 + [[0, 0, 3]] * 2, [np.sqrt(6)] * 4),
    ],
)
def test_few_and_coinciding_points(points: list[list[float]], scales: list[float]) -> None:
    np.testing.assert_allclose(initial_scales(np.array(points, dtype=np.float32)), np.array(scales), rtol=1e-6)


def test_misuse() -> None:
    with pytest.raises(ValueError, match="n >= 1"):
        random_points(0, -1, 1, 0)
    with pytest.raises(ValueError, match="low < high"):
        random_points(3, 1, -1, 0)
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        initial_scales(np.zeros((0, 3)))
