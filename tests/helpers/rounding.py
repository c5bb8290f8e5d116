"""How a device rounds."""

from lapgs_wgpu.gpu.device import Device


def divides_exactly(device: Device) -> bool:
    """Whether quotients are the nearest floats, as on the software drivers; WGSL allows 2.5 units in the last place."""
    return bool(device.wgpu_device.adapter.info["adapter_type"] == "CPU")
