"""Graphics adapters and opened devices."""

import ctypes.util
import functools
import os
import sys
from dataclasses import dataclass
from typing import Any, NamedTuple

from lapgs_wgpu.errors import NoAdapterError
from lapgs_wgpu.gpu.cffi_patch import parse_named_types_only

_WANTED_FEATURES = ("subgroup", "timestamp-query")

# WebGPU's default limits, which suffice for every kernel; larger bindings are used if the adapter has them.
_DEFAULT_LIMITS = {
    "max-storage-buffers-per-shader-stage": 8,
    "max-storage-buffer-binding-size": 128 << 20,
    "max-buffer-size": 256 << 20,
    "max-compute-workgroup-storage-size": 16384,
    "max-compute-invocations-per-workgroup": 256,
    "max-compute-workgroups-per-dimension": 65535,
}
_RAISED_LIMITS = ("max-storage-buffer-binding-size", "max-buffer-size", "max-storage-textures-per-shader-stage")

# Mesa's software driver silently ends an invocation after this many iterations of all its loops together.
SOFTWARE_LOOP_TURNS = 65_535

_INSTALL_HINTS = {
    "linux": "install a Vulkan driver for your graphics card, or Mesa's software driver, on Debian and Ubuntu: "
    "sudo apt-get install -y mesa-vulkan-drivers libvulkan1",
    "win32": "install the newest driver of your graphics card; D3D12 adapters need dxcompiler.dll (Microsoft's DirectX "
    "Shader Compiler) in a folder of PATH",
}


@dataclass(frozen=True)
class DeviceInfo:
    """An adapter that is not opened. kind: cpu, integrated, discrete or other."""

    name: str
    kind: str
    backend: str
    driver: str


class AdapterDetails(NamedTuple):
    """An adapter, its optional features, limits, and offered and needed values of limits too small for the kernels."""

    info: DeviceInfo
    features: list[str]
    limits: dict[str, int]
    too_small: dict[str, tuple[int, int]]


def instance_options(platform: str) -> dict[str, Any]:
    """Return options of wgpu's instance on a platform, as `sys.platform` names it.

    D3D12 is left out without dxcompiler.dll, since its older compiler, FXC, knows no subgroups and refuses barriers in
    loops.
    """
    dxc = ctypes.util.find_library("dxcompiler") if platform == "win32" else None
    # Not OpenGL: it offers the same hardware with fewer features.
    backends = ["Vulkan", "Metal", "DX12"] if dxc or platform != "win32" else ["Vulkan", "Metal"]
    options: dict[str, Any] = {"backends": backends, "flags": ["Empty"]}
    return options | ({"dx12_compiler": "Dxc", "dxc_path": dxc} if dxc else {})


@functools.cache
def _instance() -> Any:
    """Return wgpu's instance, with the backends of `instance_options`."""
    os.environ.setdefault("XDG_RUNTIME_DIR", "/tmp")  # otherwise Mesa prints a warning
    import wgpu
    from wgpu.backends.wgpu_native import ffi
    from wgpu.backends.wgpu_native.extras import set_instance_extras

    parse_named_types_only(ffi)
    set_instance_extras(**instance_options(sys.platform))
    return wgpu.gpu


def _adapters() -> list[tuple[DeviceInfo, Any]]:
    found = []
    for adapter in _instance().enumerate_adapters_sync():
        info = adapter.info
        kinds = {"CPU": "cpu", "IntegratedGPU": "integrated", "DiscreteGPU": "discrete"}
        kind = kinds.get(info["adapter_type"], "other")
        found.append((DeviceInfo(info["device"], kind, info["backend_type"], info["description"]), adapter))
    order = ("discrete", "integrated", "other", "cpu")
    # Prefer Vulkan, on which the kernels were tested, to D3D12 on the same card.
    return sorted(found, key=lambda pair: (order.index(pair[0].kind), pair[0].backend != "Vulkan"))


def list_devices() -> list[DeviceInfo]:
    """Find the adapters of this machine.

    Returns:
        Their names, kinds (cpu, integrated, discrete or other), backends and drivers; the default one comes first.
    """
    return [info for info, _ in _adapters()]


def _details(info: DeviceInfo, adapter: Any) -> AdapterDetails:
    features = [name for name in _WANTED_FEATURES if name in adapter.features]
    limits = {name: int(adapter.limits[name]) for name in dict.fromkeys((*_DEFAULT_LIMITS, *_RAISED_LIMITS))}
    too_small = {name: (limits[name], value) for name, value in _DEFAULT_LIMITS.items() if limits[name] < value}
    return AdapterDetails(info, features, limits, too_small)


def adapter_details() -> list[AdapterDetails]:
    """List the adapters as `list_devices` does, with features and limits."""
    return [_details(*pair) for pair in _adapters()]


class Device:
    """An opened adapter.

    wgpu_device, queue: wgpu's objects.
    textures: whether tables are read through textures (gpu/shader), which is much faster on Mesa's software driver.
    watchdog: whether the driver ends a submission that takes seconds, as on Windows and macOS (all but CPU devices).
    recording: the Recording that is made now; None where none is.
    generation: number of buffers that pools have made: what was recorded before the last one may use a freed one.
    """

    def __init__(self, adapter: Any, info: DeviceInfo) -> None:
        _, self.features, offered, too_small = _details(info, adapter)
        for name, (offer, needed) in too_small.items():
            raise NoAdapterError(
                f"the adapter {info.name!r} offers {name} = {offer}, but {needed} is needed: "
                "choose another with --device"
            )
        self.info, self.limits = info, _DEFAULT_LIMITS | {name: offered[name] for name in _RAISED_LIMITS}
        try:
            self.wgpu_device = adapter.request_device_sync(required_features=self.features, required_limits=self.limits)
        except RuntimeError as error:  # wgpu-py's only type for it
            reason = str(error).splitlines()[0]
            raise NoAdapterError(f"the adapter {info.name!r} cannot be opened ({reason}): choose another") from error
        self.queue = self.wgpu_device.queue
        self.is_cpu = info.kind == "cpu"
        self.watchdog = not self.is_cpu
        self.textures = self.is_cpu and self.limits["max-storage-textures-per-shader-stage"] >= 8
        self.kernel_cache: dict[Any, Any] = {}
        self.generation = 0
        self.recording: Any = None

    @property
    def max_binding(self) -> int:
        """Largest size of one binding, bytes."""
        return int(self.limits["max-storage-buffer-binding-size"])


def _matches(info: DeviceInfo, wanted: str) -> bool:
    return wanted.lower() in (info.kind, info.backend.lower()) or wanted.lower() in info.name.lower()


def open_device(name: str | None = None) -> Device:
    """Open an adapter. Equal arguments give the same Device.

    Args:
        name: part of the adapter's name, or its kind (cpu, integrated, discrete). None: the environment variable
            LAPGS_DEVICE, otherwise the best adapter.

    Returns:
        The opened adapter.

    Raises:
        NoAdapterError: no adapter, or none that matches.
    """
    return _open_device(name or os.environ.get("LAPGS_DEVICE") or None)


@functools.cache
def _open_device(name: str | None) -> Device:
    adapters = _adapters()
    if not adapters:
        hint = _INSTALL_HINTS.get(sys.platform, "install the newest driver of your graphics card")
        raise NoAdapterError(f"no Vulkan, Metal or D3D12 adapter was found on this machine: {hint}")
    for info, adapter in adapters:
        if name is None or _matches(info, name):
            return Device(adapter, info)
    there = ", ".join(f"{info.name!r} ({info.kind})" for info, _ in adapters)
    raise NoAdapterError(f"no adapter matches --device {name!r}; this machine has: {there}")
