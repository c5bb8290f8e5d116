"""Exclusive scan on the device. The number of elements is read on the device."""

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel

_BLOCK_ITEMS = 2048  # common/block.wgsl


def scan(
    commands: Commands,
    pool: BufferPool,
    name: str,
    *,
    length: DeviceArray,
    values: DeviceArray,
    prefix: DeviceArray,
    total: DeviceArray,
    indices: DeviceArray | None = None,
    flags: bool = False,
) -> None:
    """Record prefix[i] = sum of the first i elements, total[0] = sum of all; elements = length[0] <= prefix.size.

    Element i is a u32 below 2^21: values[i]; with `indices` values[indices[i]]; with `flags` 1 if values[i] is not
    zero. A total above 2^32 - 1 is given as 2^32 - 1.
    """
    count = max(1, -(-prefix.size // _BLOCK_ITEMS))
    sums = pool.array(f"{name} block sums", (count,), "uint32")
    arrays = {"length": length, "values": values, "indices": indices, "block_sums": sums}
    arrays |= {"prefix": prefix, "total": total}
    defines = {"SCAN_LANES": 8 if pool.device.is_cpu else 256, "FLAGS": flags, "GATHER": indices is not None}
    for shader in ("scan_reduce", "scan_apply") if count > 1 else ("scan_apply",):
        commands.run(Kernel.get(pool.device, shader, **defines), count, arrays)
