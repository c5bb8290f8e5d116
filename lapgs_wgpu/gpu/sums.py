"""Sums of the columns of a matrix."""

from __future__ import annotations

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool


def sum_columns(
    commands: Commands,
    pool: BufferPool,
    values: DeviceArray,
    totals: DeviceArray,
    *,
    columns: int = 1,
    place: int = 0,
    factor: float = 1.0,
) -> None:
    """Record the sums of the columns of values, times a factor, into `totals` from `place` on."""
    kernel = Kernel.get(commands.device, "sum_values")
    content = kernel.uniform("Values", rows=values.size // columns, columns=columns, place=place, factor=factor)
    commands.dispatch(kernel, columns, sum=pool.constant(content), values=values, totals=totals)
