"""The subgroup size of a device, measured."""

from __future__ import annotations

import functools

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel

_LANES = 64  # of a workgroup, as many as the raster passes have at most


@functools.cache
def subgroup_size(device: Device) -> int:
    """Return the lanes of a subgroup, 0 without subgroups, as a kernel measures them: adapters are unreliable there."""
    if "subgroup" not in device.features:
        return 0
    sizes = DeviceArray.empty(device, "subgroup sizes", (_LANES,), "uint32")
    with Commands(device) as commands:
        commands.dispatch(Kernel.get(device, "probe_subgroup"), 1, sizes=sizes)
    found = set(sizes.read().tolist())
    return found.pop() if len(found) == 1 else 0
