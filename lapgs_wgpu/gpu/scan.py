"""Exclusive scan on the device. The number of elements is read on the device."""

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel

_BLOCK_ITEMS = 2048  # common/block.wgsl


class Scan:
    """Exclusive prefix sums of u32 below 2^21. A total above 2^32 - 1 is given as 2^32 - 1.

    source: of element i; "values": values[i]; "flags": 1 if values[i] is not zero; "gather": values[indices[i]].
    """

    def __init__(self, device: Device, pool: BufferPool, name: str, source: str = "values") -> None:
        self._pool, self._name = pool, name
        lanes = 8 if device.is_cpu else 256
        defines = {"SCAN_LANES": lanes, "FLAGS": source == "flags", "GATHER": source == "gather"}
        self._reduce = Kernel.get(device, "scan_reduce", **defines)
        self._apply = Kernel.get(device, "scan_apply", **defines)

    def __call__(
        self,
        commands: Commands,
        *,
        length: DeviceArray,
        capacity: int,
        values: DeviceArray,
        prefix: DeviceArray,
        total: DeviceArray,
        indices: DeviceArray | None = None,
    ) -> None:
        """Record prefix[i] = sum of the first i elements, total[0] = sum of all; elements = length[0] <= capacity."""
        count = max(1, -(-capacity // _BLOCK_ITEMS))
        sums = self._pool.array(f"{self._name} block sums", (count,), "uint32")
        arrays = {"length": length, "values": values, "indices": indices, "block_sums": sums}
        if count > 1:
            commands.run(self._reduce, count, arrays)
        commands.run(self._apply, count, {**arrays, "prefix": prefix, "total": total})
