"""Columns of numbers as whole numbers of 8 or 16 bits, with the lowest value and the step of each column."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


def quantize(
    values: Floats, bits: int, *, centered: bool = False, starts: Sequence[int] = (0,)
) -> tuple[NDArray[np.uint8] | NDArray[np.uint16], Floats]:
    """Round values (rows, columns) to 2^bits levels.

    bits: 2 to 16; more than 8 give uint16. centered: the levels lie evenly about zero, which is one of them, exactly so
    up to 8 bits.
    starts: first rows of the parts that have ranges of their own, ascending from 0.
    Returns (columns, rows) of whole numbers q and the ranges (parts, columns, 2): value = range[0] + range[1] * q.
    """
    top = (1 << bits) - (2 if centered else 1)  # an even number of steps has a middle
    whole = np.empty(values.shape, np.uint16 if bits > 8 else np.uint8)
    ranges = np.zeros((len(starts), values.shape[1], 2), np.float32)
    for part, rows in enumerate(_parts(starts, len(values))):
        exact = values[rows].astype(np.float64)
        low, high = exact.min(axis=0, initial=np.inf), exact.max(axis=0, initial=-np.inf)
        if centered:
            high = np.maximum(np.abs(low), np.abs(high))
            low = -high
        step = ((high - low) / top).astype(np.float32)
        if centered:
            step = ((step.view(np.uint32) + 0x80) & 0xFFFFFF00).view(
                np.float32
            )  # so that its multiples up to 127 are exact
        low = -step * np.float32(top / 2) if centered else low.astype(np.float32)
        ranges[part, :, 0], ranges[part, :, 1] = low, step
        share = (exact - low) / np.where(step > 0, step, 1)
        whole[rows] = np.rint(share).clip(0, top)
    return np.ascontiguousarray(whole.T), ranges


def dequantize(whole: NDArray[Any], ranges: Floats, starts: Sequence[int] = (0,)) -> Floats:
    """The values (rows, columns) of `quantize`. One rounding to float32, so that every reader has the same bits."""
    exact = ranges.astype(np.float64)
    values = np.empty(whole.shape[::-1], np.float32)
    for part, rows in enumerate(_parts(starts, len(values))):
        values[rows] = (exact[part, :, 0] + exact[part, :, 1] * whole[:, rows].T).astype(np.float32)
    return values


def _parts(starts: Sequence[int], rows: int) -> list[slice]:
    return [slice(first, last) for first, last in zip(starts, [*starts[1:], rows], strict=True)]
