"""Values between the moments that playback has evaluated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lapgs_wgpu.motion.playback import seen_moments as module
from lapgs_wgpu.motion.playback.seen_moments import SeenMoments

PARTS, COUNT = 16, 5
RANDOM = np.random.default_rng(0)
START, SPEED, BEND = RANDOM.normal(size=(3, COUNT, 14)).astype(np.float32)


def parabola(t: float) -> np.ndarray:
    return START + np.float32(t) * SPEED + np.float32(t * t) * BEND


def seen(times: np.ndarray, at: Callable[[float], np.ndarray] = parabola) -> SeenMoments:
    moments = SeenMoments(COUNT, 2 / PARTS)
    for t in times.tolist():
        moments.add(at(t), t)
    return moments


@pytest.mark.parametrize("t", [0.2, 0.31, 0.5, 0.77])
def test_a_parabola_is_off_by_a_quarter_of_the_error(t: float) -> None:
    """At moments that are not evenly spaced, in any order."""
    times = RANDOM.permutation((np.arange(PARTS) + RANDOM.uniform(0.3, 0.7, PARTS)) / PARTS)
    values, error = seen(times).between(t)
    assert values.shape == error.shape == (14, COUNT)
    off = np.abs(values - parabola(t).T)
    np.testing.assert_allclose(4 * off, error, rtol=2e-3, atol=1e-5)
    assert off.max() > 1e-4


@pytest.mark.parametrize("kink", [0.47, 0.5, 0.51, 0.52])
def test_a_kink_is_off_by_the_error_at_most(kink: float) -> None:
    def at(t: float) -> np.ndarray:
        return np.full((COUNT, 14), max(0.0, t - kink), np.float32)

    moments = seen((np.arange(PARTS) + 0.5) / PARTS, at)
    for t in np.linspace(0.475, 0.53, 23).tolist():
        values, error = moments.between(t)
        off = np.abs(values - at(t).T).max()
        assert off <= error.min() + 1e-6
        assert t != kink or off > 0.9 * error.max() > 0
    assert moments.between(0.25)[1].max() < 1e-6


def test_at_a_moment_nothing_is_off() -> None:
    times = (np.arange(PARTS) + 0.5) / PARTS
    values, error = seen(times).between(float(times[7]))
    np.testing.assert_array_equal(values, parabola(float(times[7])).T)
    assert error.max() == 0


def test_only_between_four_moments_that_are_near_each_other() -> None:
    times = (np.arange(PARTS) + 0.5) / PARTS
    moments = seen(times)
    assert [moments.between(t) is None for t in (0.0, 0.05, 0.1, 0.9, 0.95, 1.0)] == [
        True,
        True,
        False,
        False,
        True,
        True,
    ]
    assert seen(times[:3]).between(0.1) is None
    gap = seen(np.delete(times, [7, 8]))
    assert [gap.between(t) is None for t in (0.3, 0.4, 0.5, 0.6, 0.7)] == [False, True, True, True, False]


def test_moments_are_apart_and_no_more_than_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    assert seen(np.array([0.5, 0.51, 0.475, 0.54, 0.465, 0.5]))._times == [0.465, 0.5, 0.54]
    monkeypatch.setattr(module, "_MOST_BYTES", 14 * 4 * COUNT * 6)
    assert len(seen((np.arange(PARTS) + 0.5) / PARTS)._times) == 6
