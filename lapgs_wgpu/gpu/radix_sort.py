"""Stable radix sort on the device. The number of elements is read on the device."""

import struct

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.scan import Scan

_SORT_BLOCK_ITEMS = 2048  # common/sort.wgsl: 128 lanes x 16 elements
# Of runs, and of blocks: adding up their counters in each lane, or workgroup, takes less time than a scan's dispatches.
FEW_RUNS, FEW_BLOCKS = 32, 256


def runs(capacity: int) -> int:
    """Return the number of runs, a lane each, of lists with room for so many elements (LANE_RUNS)."""
    return 16 if capacity <= 8 * 4096 else 8 * min(128, max(4, capacity // (8 * 4096)))


class RadixSort:
    """A stable sort of u32 keys with a u32 payload, least significant digit first.

    lane_runs: variant for CPU devices: digits of up to 8 bits, a run of elements per lane. Otherwise 4-bit digits are
    ranked in workgroups. Both give the same result.
    """

    def __init__(self, device: Device, pool: BufferPool, name: str, *, lane_runs: bool) -> None:
        self._device, self._pool, self._name, self._lane_runs = device, pool, name, lane_runs
        self._scan = Scan(device, pool, name)

    def __call__(
        self,
        commands: Commands,
        *,
        length: DeviceArray,
        capacity: int,
        bits: int,
        keys: DeviceArray,
        payload: DeviceArray | None,
    ) -> tuple[DeviceArray, DeviceArray]:
        """Sort the first length[0] <= capacity elements by the lowest `bits` bits of their keys.

        payload: None stands for 0, 1, 2, ... `keys` and `payload` are overwritten. Returns sorted keys and payload.
        """
        widest = 8 if self._lane_runs else 4
        passes = -(-bits // widest)
        width = -(-bits // passes) if self._lane_runs else widest
        digits = 1 << width
        owners = runs(capacity) if self._lane_runs else -(-capacity // _SORT_BLOCK_ITEMS)
        unsummed = owners <= (FEW_RUNS if self._lane_runs else FEW_BLOCKS)
        counters = self._pool.array(f"{self._name} counters", (digits * owners,), "uint32")
        keys_out = self._pool.array(f"{self._name} keys", (capacity,), "uint32")
        payload_out = self._pool.array(f"{self._name} payload", (capacity,), "uint32")
        second_payload = payload or self._pool.array(f"{self._name} second payload", (capacity,), "uint32")
        groups = owners // 8 if self._lane_runs else owners
        count_kernel = Kernel.get(self._device, "sort_count", LANE_RUNS=self._lane_runs)
        for step in range(passes):
            sizes = {"shift": step * width, "digits": digits, "owners": owners, "capacity": capacity}
            uniform = self._pool.constant(count_kernel.uniform("Sort", **sizes))
            arrays = {"sort": uniform, "length": length, "keys": keys}
            commands.dispatch(count_kernel, groups, counters=counters, **arrays)
            places = counters if unsummed else self._summed(commands, counters)
            arrays |= {"counters": places, "keys_out": keys_out, "payload_out": payload_out, "payload": second_payload}
            iota = step == 0 and payload is None
            scatter = Kernel.get(self._device, "sort_scatter", LANE_RUNS=self._lane_runs, UNSUMMED=unsummed, IOTA=iota)
            commands.run(scatter, groups, arrays)
            keys, keys_out = keys_out, keys
            second_payload, payload_out = payload_out, second_payload
        return keys, second_payload

    def _summed(self, commands: Commands, counters: DeviceArray) -> DeviceArray:
        """Return the counters' exclusive prefix sums: the place of each counter's first element."""
        (count,) = counters.shape
        places = self._pool.array(f"{self._name} places", (count,), "uint32")
        total = self._pool.array(f"{self._name} total", (1,), "uint32")
        length = self._pool.constant(struct.pack("<I", count))
        self._scan(commands, length=length, capacity=count, values=counters, prefix=places, total=total)
        return places
