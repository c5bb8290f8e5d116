"""The exclusive scan against numpy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.scan import scan as scan_on_device

pytestmark = pytest.mark.kernels

Words = NDArray[np.uint32]
UNTOUCHED = 0xDEADBEEF
SOURCES = ["values", "flags", "gather"]


def scan(
    device: Device,
    values: Words,
    *,
    source: str,
    length: int,
    indices: Words | None = None,
    capacity: int | None = None,
) -> tuple[Words, int]:
    """The first `length` sums and the total. Fails where anything else was written."""
    capacity = length if capacity is None else capacity
    prefix = DeviceArray.upload(device, "prefix", np.full(capacity + 64, UNTOUCHED, np.uint32))
    total = DeviceArray.upload(device, "total", np.full(4, UNTOUCHED, np.uint32))
    picked = {} if indices is None else {"indices": DeviceArray.upload(device, "indices", indices)}
    with Commands(device) as commands:
        scan_on_device(
            commands,
            BufferPool(device),
            "test",
            length=DeviceArray.upload(device, "length", np.array([length], np.uint32)),
            values=DeviceArray.upload(device, "values", values),
            prefix=prefix.rows(0, capacity),
            total=total,
            flags=source == "flags",
            **picked,
        )
    sums = prefix.read()
    assert (sums[length:] == UNTOUCHED).all()
    return sums[:length], int(total.read()[0])


def check(
    device: Device, values: Words, *, source: str, length: int, capacity: int | None = None, seed: int = 0
) -> None:
    indices = None
    elements = values[:length]
    if source == "gather":
        indices = np.random.default_rng(seed).integers(0, max(1, len(values)), max(1, length)).astype(np.uint32)
        elements = values[indices[:length]] if length else elements
    elif source == "flags":
        elements = (elements != 0).astype(np.uint32)
    expected = np.concatenate([[0], np.cumsum(elements, dtype=np.uint32)])
    sums, total = scan(device, values, source=source, length=length, indices=indices, capacity=capacity)
    np.testing.assert_array_equal(sums, expected[:-1])
    assert total == expected[-1]


@pytest.mark.parametrize("length", [0, 1, 7, 2047, 2048, 2049, 4096, 100_000])
@pytest.mark.parametrize("source", SOURCES)
def test_lengths_around_the_blocks(device: Device, source: str, length: int) -> None:
    values = np.random.default_rng(length).integers(0, 3, max(1, length)).astype(np.uint32)
    check(device, values, source=source, length=length)


@pytest.mark.parametrize("source", SOURCES)
def test_more_blocks_than_one_workgroup_has_lanes(device: Device, source: str) -> None:
    """Each workgroup adds the sums of the blocks before its own, some at a time."""
    values = np.random.default_rng(1).integers(0, 1000, 2048 * 300 + 5).astype(np.uint32)
    check(device, values, source=source, length=len(values))


@pytest.mark.parametrize("length", [0, 1, 2048, 5000])
@pytest.mark.parametrize("source", SOURCES)
def test_the_length_is_the_devices(device: Device, source: str, length: int) -> None:
    """Buffers that hold more than there is: what lies behind the length counts for nothing."""
    values = np.full(20_000, (1 << 18) - 1, np.uint32)
    values[:length] = np.arange(length)
    check(device, values, source=source, length=length, capacity=20_000)


def test_no_room_and_no_elements(device: Device) -> None:
    sums, total = scan(device, np.zeros(4, np.uint32), source="values", length=0, capacity=0)
    assert len(sums) == 0
    assert total == 0


@pytest.mark.parametrize("length", [6000, 40_000, 300_000])
def test_sums_end_at_the_largest_word(device: Device, length: int) -> None:
    values = np.full(length, (1 << 21) - 1, np.uint32)
    assert scan(device, values, source="values", length=length)[1] == 0xFFFFFFFF
    sums, total = scan(device, values[:2000], source="values", length=2000)
    np.testing.assert_array_equal(sums, np.arange(2000) * ((1 << 21) - 1))
    assert total == 2000 * ((1 << 21) - 1)
