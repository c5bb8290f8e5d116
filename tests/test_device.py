"""Choosing an adapter and opening it."""

import os
import re
import subprocess
import sys
from typing import Any

import pytest

from lapgs_wgpu.errors import NoAdapterError
from lapgs_wgpu.gpu import device as module
from lapgs_wgpu.gpu.device import Device, DeviceInfo, list_devices, open_device
from lapgs_wgpu.splat.raster_config import subgroup_size

DISCRETE = DeviceInfo("Fast Card 9000", "discrete", "Vulkan", "v1")
INTEGRATED = DeviceInfo("Chip Graphics", "integrated", "Vulkan", "v2")
SOFTWARE = DeviceInfo("llvmpipe (LLVM 15.0.6, 256 bits)", "cpu", "Vulkan", "v3")


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Any:
    """open_device over three made-up adapters; it returns the info of the one that it would open."""
    found = [(DISCRETE, None), (INTEGRATED, None), (SOFTWARE, None)]
    monkeypatch.setattr(module, "_adapters", lambda: found)
    monkeypatch.setattr(module, "Device", lambda adapter, info: info)
    monkeypatch.delenv("LAPGS_DEVICE", raising=False)
    return lambda name=None: module._open_device.__wrapped__(name or os.environ.get("LAPGS_DEVICE"))


# Which adapter


def test_the_best_adapter_is_the_default(opened: Any) -> None:
    assert opened() == DISCRETE
    assert opened(None) == DISCRETE


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cpu", SOFTWARE),
        ("integrated", INTEGRATED),
        ("card 9000", DISCRETE),
        ("vulkan", DISCRETE),
    ],
)
def test_choosing_by_kind_name_or_backend(opened: Any, name: str, expected: DeviceInfo) -> None:
    assert opened(name) == expected


def test_the_environment_chooses_where_nothing_else_does(opened: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAPGS_DEVICE", "llvm")
    assert opened() == SOFTWARE
    assert opened("integrated") == INTEGRATED
    monkeypatch.setenv("LAPGS_DEVICE", "")
    assert opened() == DISCRETE


def test_an_unknown_name_lists_what_is_there(opened: Any) -> None:
    with pytest.raises(NoAdapterError) as caught:
        opened("quantum")
    message = str(caught.value)
    assert "'quantum'" in message
    for info in (DISCRETE, INTEGRATED, SOFTWARE):
        assert f"{info.name!r} ({info.kind})" in message
    assert "\n" not in message


def test_no_adapter_at_all_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_adapters", list)
    for name in (None, "cpu"):
        with pytest.raises(NoAdapterError, match=r"no Vulkan, Metal or D3D12 adapter .* mesa-vulkan-drivers"):
            module._open_device.__wrapped__(name)


def test_d3d12_is_used_where_its_newer_compiler_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    both = {"backends": ["Vulkan", "Metal", "DX12"], "flags": ["Empty"]}
    assert module.instance_options("linux") == module.instance_options("darwin") == both
    for dll in ("C:\\dxc\\dxcompiler.dll", None):
        monkeypatch.setattr(module.ctypes.util, "find_library", {"dxcompiler": dll}.get)
        other = {"dx12_compiler": "Dxc", "dxc_path": dll} if dll else {"backends": ["Vulkan", "Metal"]}
        assert module.instance_options("win32") == both | other
    monkeypatch.setattr(module, "_adapters", list)
    monkeypatch.setattr(module.sys, "platform", "win32")
    with pytest.raises(NoAdapterError, match=r"D3D12 adapters need dxcompiler\.dll .* in a folder of PATH$"):
        module._open_device.__wrapped__(None)


@pytest.mark.skipif(sys.platform != "linux", reason="the Vulkan loader's variables mean nothing here")
def test_a_machine_without_a_driver_really_has_no_adapter() -> None:
    program = (
        "from lapgs_wgpu.gpu.device import list_devices, open_device\n"
        "from lapgs_wgpu.errors import NoAdapterError\n"
        "assert list_devices() == []\n"
        "try: open_device()\n"
        "except NoAdapterError as error: print('refused:', error)"
    )
    nowhere = {"VK_DRIVER_FILES": "/nowhere.json", "VK_ICD_FILENAMES": "/nowhere.json"}
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=os.environ | nowhere)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("refused: no Vulkan, Metal or D3D12 adapter")


class _Adapter:
    """What an adapter of wgpu says of itself."""

    def __init__(self, name: str, kind: str, backend: str = "Vulkan", **limits: int) -> None:
        self.info = {"device": name, "adapter_type": kind, "backend_type": backend, "description": "driver"}
        self.features = {"subgroup", "shader-float32-atomic", "mappable-primary-buffers"}
        self.limits = dict.fromkeys((*module._DEFAULT_LIMITS, *module._RAISED_LIMITS), 1 << 30) | limits
        self.requests: list[dict[str, Any]] = []

    def request_device_sync(self, **request: Any) -> Any:
        self.requests.append(request)
        return type("FakeDevice", (), {"queue": None})()


def test_adapters_are_ordered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The default first; Vulkan before the same card through D3D12."""
    big, small = "DiscreteGPU", "IntegratedGPU"
    kinds = [("soft", "CPU"), ("odd", "Unknown"), ("big", big, "D3D12"), ("big", big), ("small", small)]
    adapters = [_Adapter(*kind) for kind in kinds]
    instance = type("Instance", (), {"enumerate_adapters_sync": lambda self: adapters})()
    monkeypatch.setattr(module, "_instance", lambda: instance)
    assert [(info.name, info.kind, info.backend) for info in list_devices()] == [
        ("big", "discrete", "Vulkan"),
        ("big", "discrete", "D3D12"),
        ("small", "integrated", "Vulkan"),
        ("odd", "other", "Vulkan"),
        ("soft", "cpu", "Vulkan"),
    ]


# What is asked of it


def test_only_features_with_a_use_are_requested_and_no_float_atomics() -> None:
    adapter = _Adapter("soft", "CPU")
    Device(adapter, SOFTWARE)
    assert adapter.requests[0]["required_features"] == ["subgroup"]


def test_limits_are_the_webgpu_defaults_and_larger_bindings() -> None:
    adapter = _Adapter("soft", "CPU")
    Device(adapter, SOFTWARE)
    limits = adapter.requests[0]["required_limits"]
    assert limits["max-storage-buffers-per-shader-stage"] == 8
    assert limits["max-storage-buffer-binding-size"] == 1 << 30


def test_an_adapter_below_the_limits_is_refused() -> None:
    adapter = _Adapter("tiny", "IntegratedGPU", **{"max-compute-workgroup-storage-size": 8192})
    expected = "'Chip Graphics' offers max-compute-workgroup-storage-size = 8192, but 16384"
    with pytest.raises(NoAdapterError, match=expected):
        Device(adapter, INTEGRATED)


# This machine's


def test_one_device_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = list_devices()[0].kind
    assert open_device(kind) is open_device(kind)
    assert open_device(kind).info == list_devices()[0]


@pytest.mark.kernels
@pytest.mark.subgroups
def test_subgroup_size_is_measured(device: Device, configuration: str) -> None:
    assert "shader-float32-atomic" not in device.features
    if configuration == "no-subgroups" or "subgroup" not in device.features:
        assert subgroup_size(device) == 0
        return
    width = re.search(r"llvmpipe .*, (\d+) bits", device.info.name)
    if width:  # Mesa's software driver runs 32 bits a lane
        assert subgroup_size(device) == int(width[1]) // 32
    else:
        assert subgroup_size(device) in (0, 4, 8, 16, 32, 64, 128)
