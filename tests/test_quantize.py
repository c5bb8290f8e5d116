"""Columns of numbers as whole numbers, and back."""

from __future__ import annotations

import numpy as np
import pytest

from lapgs_wgpu.motion.quantize import dequantize, quantize


@pytest.mark.parametrize("bits", [2, 5, 8, 12, 16])
@pytest.mark.parametrize("centered", [False, True])
def test_the_error_is_half_a_step(bits: int, centered: bool) -> None:
    values = (np.random.default_rng(0).normal(size=(500, 3)) * [1, 100, 1e-3] + [0, 50, 7]).astype(np.float32)
    whole, ranges = quantize(values, bits, centered=centered)
    assert whole.dtype == (np.uint16 if bits > 8 else np.uint8)
    assert whole.shape == (3, 500)
    assert whole.max() < 1 << bits
    back = dequantize(whole, ranges)
    steps = ranges[0, :, 1].astype(np.float64)
    assert (np.abs(back - values) <= 0.501 * steps + 2e-5 * np.abs(values)).all()
    spread = 2 * np.abs(values).max(axis=0) if centered else np.ptp(values, axis=0)
    np.testing.assert_allclose(steps, spread / ((1 << bits) - (2 if centered else 1)), rtol=2e-5)


def test_centered_levels_hold_zero() -> None:
    values = np.array([[-0.3], [0.0], [1e-5], [0.7]], np.float32)
    back = dequantize(*quantize(values, 6, centered=True))
    assert back[1] == back[2] == 0


def test_parts_have_ranges_of_their_own() -> None:
    values = np.array([[1.0], [2.0], [1000.0], [5000.0], [3000.0]], np.float32)
    whole, ranges = quantize(values, 8, starts=[0, 2])
    assert ranges.shape == (2, 1, 2)
    np.testing.assert_allclose(dequantize(whole, ranges, [0, 2]), values, rtol=3e-3)


@pytest.mark.parametrize("values", [np.zeros((4, 2)), np.full((4, 2), 3.5), np.zeros((0, 2))])
def test_columns_of_one_value(values: np.ndarray) -> None:
    values = values.astype(np.float32)
    for centered in (False, True):
        back = dequantize(*quantize(values, 8, centered=centered))
        np.testing.assert_allclose(back, values, rtol=2e-5)
