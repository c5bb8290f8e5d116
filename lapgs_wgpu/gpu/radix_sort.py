"""Stable radix sort on the device. The number of elements is read on the device."""

import struct

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.scan import scan

_SORT_BLOCK_ITEMS = 2048  # common/sort.wgsl: 128 lanes x 16 elements
# Of runs, and of blocks: adding up their counters in each lane, or workgroup, takes less time than a scan's dispatches.
FEW_RUNS, FEW_BLOCKS = 32, 256


def runs(capacity: int) -> int:
    """Return the number of runs, a lane each, of lists with room for so many elements (LANE_RUNS)."""
    return 16 if capacity <= 8 * 4096 else 8 * min(128, max(4, capacity // (8 * 4096)))


def radix_sort(
    commands: Commands,
    pool: BufferPool,
    name: str,
    length: DeviceArray,
    keys: DeviceArray,
    payload: DeviceArray | None,
    *,
    bits: int,
    lane_runs: bool,
) -> tuple[DeviceArray, DeviceArray]:
    """Sort the first length[0] <= keys.size u32 keys, with a u32 payload, by their lowest `bits` bits. Stable.

    The least significant digit comes first. payload: None stands for 0, 1, 2, ... `keys` and `payload` are overwritten.
    lane_runs: variant for CPU devices: digits of up to 8 bits, a run of elements per lane. Otherwise 4-bit digits are
    ranked in workgroups. Both give the same result. Returns sorted keys and payload.
    """
    capacity = keys.size
    widest = 8 if lane_runs else 4
    passes = -(-bits // widest)
    width = -(-bits // passes) if lane_runs else widest
    digits = 1 << width
    owners = runs(capacity) if lane_runs else -(-capacity // _SORT_BLOCK_ITEMS)
    unsummed = owners <= (FEW_RUNS if lane_runs else FEW_BLOCKS)
    count = digits * owners
    counters = places = pool.array(f"{name} counters", (count,), "uint32")
    keys_out = pool.array(f"{name} keys", (capacity,), "uint32")
    payload_out = pool.array(f"{name} payload", (capacity,), "uint32")
    second_payload = payload or pool.array(f"{name} second payload", (capacity,), "uint32")
    groups = owners // 8 if lane_runs else owners
    count_kernel = Kernel.get(pool.device, "sort_count", LANE_RUNS=lane_runs)
    for step in range(passes):
        sizes = {"shift": step * width, "digits": digits, "owners": owners, "capacity": capacity}
        uniform = pool.constant(count_kernel.uniform("Sort", **sizes))
        arrays = {"sort": uniform, "length": length, "keys": keys}
        commands.dispatch(count_kernel, groups, counters=counters, **arrays)
        if not unsummed:  # their exclusive prefix sums: the place of each counter's first element
            places = pool.array(f"{name} places", (count,), "uint32")
            total, all_of_them = pool.array(f"{name} total", (1,), "uint32"), pool.constant(struct.pack("<I", count))
            scan(commands, pool, name, length=all_of_them, values=counters, prefix=places, total=total)
        arrays |= {"counters": places, "keys_out": keys_out, "payload_out": payload_out, "payload": second_payload}
        iota = step == 0 and payload is None
        scatter = Kernel.get(pool.device, "sort_scatter", LANE_RUNS=lane_runs, UNSUMMED=unsummed, IOTA=iota)
        commands.run(scatter, groups, arrays)
        keys, keys_out = keys_out, keys
        second_payload, payload_out = payload_out, second_payload
    return keys, second_payload
