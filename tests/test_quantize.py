"""Columns of numbers as whole numbers and outliers, and back."""

import numpy as np
import pytest

from lapgs_wgpu.motion.quantize import dequantize, quantize


@pytest.mark.parametrize("bits", [2, 5, 8, 12, 16])
@pytest.mark.parametrize("centered", [False, True])
def test_the_error_is_half_a_step(bits: int, centered: bool) -> None:
    values = (np.random.default_rng(0).normal(size=(500, 3)) * [1, 100, 1e-3] + [0, 50, 7]).astype(np.float32)
    whole, ranges, outliers, _ = quantized = quantize(values, bits, centered=centered)
    assert not len(outliers)
    assert whole.dtype == (np.uint16 if bits > 8 else np.uint8)
    assert whole.shape == (3, 500)
    assert whole.max() < 1 << bits
    back = dequantize(quantized)
    steps = ranges[0, :, 1].astype(np.float64)
    assert (np.abs(back - values) <= 0.501 * steps + 2e-5 * np.abs(values)).all()
    spread = 2 * np.abs(values).max(axis=0) if centered else np.ptp(values, axis=0)
    np.testing.assert_allclose(steps, spread / ((1 << bits) - (2 if centered else 1)), rtol=2e-5)


def test_centered_levels_hold_zero() -> None:
    values = np.array([[-0.3], [0.0], [1e-5], [0.7]], np.float32)
    back = dequantize(quantize(values, 6, centered=True))
    assert back[1] == back[2] == 0


def test_parts_have_ranges_of_their_own() -> None:
    values = np.array([[1.0], [2.0], [1000.0], [5000.0], [3000.0]], np.float32)
    quantized = quantize(values, 8, starts=[0, 2])
    assert quantized.ranges.shape == (2, 1, 2)
    np.testing.assert_allclose(dequantize(quantized, [0, 2]), values, rtol=3e-3)


@pytest.mark.parametrize("values", [np.zeros((4, 2)), np.full((4, 2), 3.5), np.zeros((0, 2))])
def test_columns_of_one_value(values: np.ndarray) -> None:
    values = values.astype(np.float32)
    for centered in (False, True):
        back = dequantize(quantize(values, 8, centered=centered))
        np.testing.assert_allclose(back, values, rtol=2e-5)


CLOUD = np.random.default_rng(1).uniform(-1, 1, (5000, 3)).astype(np.float32)
FAR = np.array([[1e6, 0, 0], [-900, 30, 0], [0, 40, -1e5], [7e3, 0, 0], [0, -8e3, 0], [0, 0, 2e38]], np.float32)


@pytest.mark.parametrize("centered", [False, True])
def test_outliers_are_exact_and_widen_no_step(centered: bool) -> None:
    values = np.concatenate([CLOUD, FAR])
    quantized = quantize(values, 16, 1e-4, centered=centered)
    assert quantized.whole.dtype == np.uint16
    assert 7 <= len(quantized.outliers) <= 9  # 30 and 40 may lie in an interval with all of the cloud, in larger steps
    assert (np.diff(quantized.outliers.astype(np.int64)) > 0).all()
    back = dequantize(quantized)
    assert np.abs(back - values).max() <= 1e-4
    assert (back[np.abs(values) > 100] == values[np.abs(values) > 100]).all()


def test_what_is_allowed_to_be_far_off_is_no_outlier() -> None:
    """A scale below a pixel, say, may be any other below it."""
    values = np.concatenate([CLOUD, np.full((500, 3), -16)]).astype(np.float32)
    quantized = quantize(values, 8, np.where(values < -10, 20, 0.01))
    assert quantized.whole.dtype == np.uint8
    assert not len(quantized.outliers)
    np.testing.assert_allclose(dequantize(quantized)[:5000], CLOUD, atol=0.01)


@pytest.mark.parametrize(
    ("far", "bits", "dtype"),
    [(10, 8, np.uint8), (2000, 8, np.uint16), (4000, 16, np.float32)],
    ids=["few outliers", "more bits", "no whole numbers"],
)
def test_the_fewest_bytes(far: int, bits: int, dtype: type) -> None:
    spread = 20 if bits == 8 else 1e5
    values = np.concatenate([CLOUD, spread * CLOUD[:far]])
    quantized = quantize(values, bits, 0.01 if bits == 8 else 1e-4)
    assert quantized.whole.dtype == dtype
    assert (len(quantized.outliers) > 0) == (dtype == np.uint8)
    assert np.abs(dequantize(quantized) - values).max() <= 0.01
