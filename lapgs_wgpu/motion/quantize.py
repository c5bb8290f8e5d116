"""Columns of numbers as whole numbers of 8 or 16 bits, in an interval that holds most of them; the others stay exact.

Each value has a largest allowed error. A column's whole numbers span all of it where their step is small enough for
that; else the interval in which most values are within their allowed error. Those that are not are outliers.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_OUTLIER_BYTES = 6  # of an outlier's place and value, deflated
# Shares of a column's values, those of the smallest allowed errors, for which a step that is tried may be too large.
_SHARES = (0, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, *np.linspace(0.1, 1, 10))


class Quantized(NamedTuple):
    """value[row, column] = low + step whole[column, row], but for the outliers.

    whole: (columns, rows) uint8 or uint16; float32, which are the values, where whole numbers would take more bytes.
    ranges: (parts, columns, 2) float32, low and step. outliers: (M,) uint32, ascending: their places in `whole` as it
    lies in memory. exact: (M,) float32, their values.
    """

    whole: NDArray[Any]
    ranges: Floats
    outliers: NDArray[np.uint32]
    exact: Floats


def quantize(
    values: Floats,
    bits: int,
    allowed: NDArray[np.floating] | float = np.inf,
    *,
    centered: bool = False,
    starts: Sequence[int] = (0,),
) -> Quantized:
    """Round values (rows, columns) to 2^bits levels, or more where outliers would take more bytes than these.

    bits: 2 to 16; more than 8 give uint16. allowed: largest error of each value, broadcast to the shape of values.
    centered: the levels lie evenly about zero, which is one of them, exactly so up to 8 bits.
    starts: first rows of the parts that have ranges of their own, ascending from 0.
    """
    most = np.broadcast_to(np.asarray(allowed, np.float64), values.shape)
    identity, none = np.tile(np.array([0, 1], np.float32), (len(starts), values.shape[1], 1)), np.zeros(0, np.uint32)
    best = Quantized(np.ascontiguousarray(values.T), identity, none, none.view(np.float32))
    fewest = 4.0 * values.size
    for width in sorted({bits, max(bits, 8), 16}):
        found = _round(values, width, most, centered, starts)
        size = values.size * width / 8 + len(found.outliers) * _OUTLIER_BYTES
        if size < fewest:
            best, fewest = found, size
        if not len(found.outliers):
            break
    return best


def dequantize(quantized: Quantized, starts: Sequence[int] = (0,)) -> Floats:
    """Return the values (rows, columns). One rounding to float32, so that every reader has the same bits."""
    whole, ranges, outliers, exact = quantized
    factors = ranges.astype(np.float64)
    values = np.empty(whole.shape, np.float32)
    for part, rows in enumerate(_parts(starts, whole.shape[1])):
        values[:, rows] = factors[part, :, :1] + factors[part, :, 1:] * whole[:, rows]
    values.reshape(-1)[outliers] = exact
    return np.ascontiguousarray(values.T)


def _round(values: Floats, bits: int, allowed: NDArray[np.float64], centered: bool, starts: Sequence[int]) -> Quantized:
    top = (1 << bits) - (2 if centered else 1)  # an even number of steps has a middle
    whole = np.empty(values.shape[::-1], np.uint16 if bits > 8 else np.uint8)
    ranges = np.zeros((len(starts), values.shape[1], 2), np.float32)
    outside = np.zeros(whole.shape, bool)
    for part, rows in enumerate(_parts(starts, len(values))):
        for column in range(values.shape[1]):
            exact, most = values[rows, column].astype(np.float64), allowed[rows, column]
            low, step = _interval(exact, most, top, centered)
            number = np.rint((exact - low) / (step if step > 0 else 1)).clip(0, top)
            whole[column, rows] = number
            outside[column, rows] = np.abs(low + step * number - exact) > most
            ranges[part, column] = low, step
    outliers = np.flatnonzero(outside)
    return Quantized(whole, ranges, outliers.astype(np.uint32), np.ascontiguousarray(values.T).reshape(-1)[outliers])


def _interval(
    exact: NDArray[np.float64], allowed: NDArray[np.float64], top: int, centered: bool
) -> tuple[float, float]:
    """Return low and step, each a float32, of the interval of top steps that leaves fewest values too far off."""
    low, step = _levels(exact, top, centered)
    if (allowed >= 0.5 * step).all():
        return low, step
    allowed = np.minimum(allowed, np.ptp(exact))
    first, last = exact - 0.5 * allowed, exact + 0.5 * allowed  # what lies near enough to the interval is its end
    order, ends = np.argsort(first), np.argsort(last)
    most, inside = -1, exact
    steps = 2 * (1 - 1e-6) * np.unique(np.quantile(allowed, _SHARES))
    for finer in steps[steps < step][::-1]:
        fine, width = allowed >= 0.5 * finer, top * finer
        begin = -0.5 * width
        if not centered:  # the interval that most of first to last reach into begins at the end of one of them
            begins = last[ends[fine[ends]]]
            reached = np.searchsorted(first[order[fine[order]]], begins + width, "right") - np.arange(len(begins))
            begin = float(begins[reached.argmax()])
        within = fine & (last >= begin) & (first <= begin + width)
        if within.sum() > most:
            most, inside = int(within.sum()), exact[within].clip(begin, begin + width)
    return _levels(inside, top, centered)


def _levels(exact: NDArray[np.float64], top: int, centered: bool) -> tuple[float, float]:
    """Return low and step of an interval that holds all values, each a float32."""
    if not len(exact):
        return 0.0, 0.0
    high = np.abs(exact).max() if centered else exact.max()
    low = -high if centered else exact.min()
    step = np.array([(high - low) / top], np.float32)
    if centered:  # so that the step's multiples up to 127 are exact
        step = ((step.view(np.uint32) + 0x80) & 0xFFFFFF00).view(np.float32)
    return float(np.float32(-step[0] * np.float32(top / 2)) if centered else np.float32(low)), float(step[0])


def _parts(starts: Sequence[int], rows: int) -> list[slice]:
    return [slice(first, last) for first, last in zip(starts, [*starts[1:], rows], strict=True)]
