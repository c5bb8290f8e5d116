"""The radix sort, in both shapes, against numpy's stable sort."""

import numpy as np
import pytest
from numpy.typing import NDArray

from lapgs_wgpu.gpu import radix_sort
from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands

pytestmark = pytest.mark.kernels

Words = NDArray[np.uint32]
SIZES = [0, 1, 4095, 4096, 4097, 100_000, 200_000]  # from 163,840 on the counters of lane runs take a scan
LAST = 0xFFFFFFFF

both_shapes = pytest.mark.parametrize("lane_runs", [True, False], ids=["lane runs", "blocks"])


def random_keys(count: int, seed: int = 0, bits: int = 32) -> Words:
    return np.random.default_rng(seed).integers(0, (1 << bits) - 1, count, dtype=np.uint32, endpoint=True)


def sort(
    device: Device,
    keys: Words,
    *,
    lane_runs: bool,
    bits: int = 32,
    payload: Words | None = None,
    length: int | None = None,
    pool: BufferPool | None = None,
) -> tuple[Words, Words]:
    """The first `length` (all) keys sorted, and what they carry."""
    length = len(keys) if length is None else length
    held = {}
    for name, words in (("keys", keys), ("payload", payload), ("length", np.array([length], np.uint32))):
        if words is not None:
            held[name] = DeviceArray.upload(device, name, words)
    with Commands(device) as commands:
        given = held["length"], held["keys"], held.get("payload")
        sorted_keys, carried = radix_sort.radix_sort(
            commands, pool or BufferPool(device), "test", *given, bits=bits, lane_runs=lane_runs
        )
    count = min(length, len(keys))
    return sorted_keys.read()[:count], carried.read()[:count]


def check(
    device: Device,
    keys: Words,
    *,
    lane_runs: bool,
    bits: int = 32,
    given_payload: bool = False,
    length: int | None = None,
) -> None:
    count = min(len(keys) if length is None else length, len(keys))
    order = np.argsort(keys[:count], kind="stable")
    payload = random_keys(len(keys), seed=99) if given_payload else None
    found, carried = sort(device, keys, lane_runs=lane_runs, bits=bits, payload=payload, length=length)
    np.testing.assert_array_equal(found, keys[:count][order])
    np.testing.assert_array_equal(carried, order if payload is None else payload[:count][order])


@both_shapes
@pytest.mark.parametrize("given_payload", [False, True], ids=["numbered", "payload"])
@pytest.mark.parametrize("size", SIZES)
def test_random_keys(device: Device, lane_runs: bool, given_payload: bool, size: int) -> None:
    check(device, random_keys(size), lane_runs=lane_runs, given_payload=given_payload)


@pytest.mark.parametrize("size", SIZES)
def test_many_blocks_take_a_scan(device: Device, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radix_sort, "FEW_BLOCKS", 1)
    check(device, random_keys(size), lane_runs=False)


@both_shapes
@pytest.mark.parametrize("size", SIZES)
def test_ties_keep_their_order(device: Device, lane_runs: bool, size: int) -> None:
    check(device, random_keys(size, bits=2) * np.uint32(0x01010101), lane_runs=lane_runs)
    check(device, np.full(size, 12345, np.uint32), lane_runs=lane_runs)


@both_shapes
@pytest.mark.parametrize("size", [4097, 100_000])
def test_extreme_keys_and_orders(device: Device, lane_runs: bool, size: int) -> None:
    for keys in (
        np.zeros(size, np.uint32),
        np.full(size, LAST, np.uint32),
        np.where(random_keys(size, bits=1) == 1, LAST, 0).astype(np.uint32),
        np.arange(size, dtype=np.uint32),
        np.arange(size, dtype=np.uint32)[::-1].copy(),
        (LAST - np.arange(size)).astype(np.uint32),
        np.uint32(1) << random_keys(size, bits=5),
    ):
        check(device, keys, lane_runs=lane_runs)


@both_shapes
@pytest.mark.parametrize("bits", [1, 4, 7, 8, 11, 16])
def test_short_keys(device: Device, lane_runs: bool, bits: int) -> None:
    check(device, random_keys(5000, seed=bits, bits=bits), lane_runs=lane_runs, bits=bits)


@both_shapes
@pytest.mark.parametrize("length", [0, 1, 2, 3, 4095, 4097, 9999])
def test_the_length_is_the_devices(device: Device, lane_runs: bool, length: int) -> None:
    """What lies behind the length, though smaller than all keys, stays out."""
    keys = random_keys(10_000) | np.uint32(1)
    keys[length:] = 0
    check(device, keys, lane_runs=lane_runs, length=length)
    check(device, keys, lane_runs=lane_runs, length=length, given_payload=True)


@both_shapes
def test_a_length_beyond_the_room_is_cut(device: Device, lane_runs: bool) -> None:
    check(device, random_keys(5001), lane_runs=lane_runs, length=1_000_000)


@both_shapes
def test_one_pool_serves_long_and_short_lists_in_turn(device: Device, lane_runs: bool) -> None:
    pool = BufferPool(device)
    for size in (200_000, 3, 4096, 0, 200_000):
        keys = random_keys(size, seed=size)
        found, carried = sort(device, keys, lane_runs=lane_runs, pool=pool)
        np.testing.assert_array_equal(found, np.sort(keys))
        np.testing.assert_array_equal(carried, np.argsort(keys, kind="stable"))
