"""How much a training step asks of the device: dispatches, read-backs, bytes that cross over."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import pytest
from scenes import Scene, oblique_camera, random_scene, step
from stages import watch
from wgpu.backends.wgpu_native import GPUBuffer, GPUQueue

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.rasterize import rasterizer_of

pytestmark = pytest.mark.kernels

COUNT, CAMERA, DEGREE = 500, oblique_camera(101, 61), 2
PIXELS = CAMERA.width * CAMERA.height


class Event(NamedTuple):
    """A dispatch, a read or a write, in the order in which the host asked for them."""

    kind: str
    name: str
    nbytes: int


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[Event]:
    """All that happens from now on, seen where wgpu is called, so that no way around is missed."""
    seen: list[Event] = []
    watch(monkeypatch, lambda name: seen.append(Event("dispatch", name, 0)))
    map_sync, write_buffer, read_buffer = GPUBuffer.map_sync, GPUQueue.write_buffer, GPUQueue.read_buffer

    def mapping(self: GPUBuffer, mode: Any, offset: int = 0, size: int | None = None) -> Any:
        seen.append(Event("read" if "READ" in str(mode) else "write", self.label, size or self.size - offset))
        return map_sync(self, mode, offset, size)

    def writing(self: GPUQueue, buffer: GPUBuffer, offset: int, data: Any, *rest: Any) -> Any:
        seen.append(Event("write", buffer.label, memoryview(data).nbytes))
        return write_buffer(self, buffer, offset, data, *rest)

    def reading(self: GPUQueue, *arguments: Any) -> Any:
        raise AssertionError("queue.read_buffer is a hundred times slower than mapping")

    monkeypatch.setattr(GPUBuffer, "map_sync", mapping)
    monkeypatch.setattr(GPUQueue, "write_buffer", writing)
    monkeypatch.setattr(GPUQueue, "read_buffer", reading)
    assert read_buffer is not GPUQueue.read_buffer
    return seen


@pytest.fixture(scope="module")
def scene(device: Device) -> Scene:
    """Drawn once before, so that all buffers have their size."""
    scene = random_scene(COUNT, 1, sh=16)
    step(scene, CAMERA, device, sh_degree=DEGREE)
    return scene


def test_no_read_back_before_the_image_is_drawn(device: Device, scene: Scene, events: list[Event]) -> None:
    step(scene, CAMERA, device, sh_degree=DEGREE)
    dispatched = [i for i, event in enumerate(events) if event.kind == "dispatch"]
    last_of_forward = next(i for i in dispatched if events[i].name == "rasterize")
    assert not [event for event in events[:last_of_forward] if event.kind == "read"]
    before_sort = [event for event in events[:last_of_forward] if event.name.startswith("sort")]
    assert before_sort


def test_two_read_backs_a_step(device: Device, scene: Scene, events: list[Event]) -> None:
    """One wait for the image, one for the gradients; each reads several buffers."""
    step(scene, CAMERA, device, sh_degree=DEGREE)
    kinds = [event.kind for event in events]
    waits = sum(a == "read" and b != "read" for a, b in zip(kinds, [*kinds[1:], ""], strict=True))
    assert waits == 2


def test_dispatches_a_step(device: Device, scene: Scene, events: list[Event]) -> None:
    """By the plan: what a sort needs follows from the width of its digits, all else is counted."""
    step(scene, CAMERA, device, sh_degree=DEGREE)
    names = [event.name for event in events if event.kind == "dispatch"]
    shape = rasterizer_of(device).shape
    tiles = math.ceil(CAMERA.width / shape.tile_width) * math.ceil(CAMERA.height / shape.tile_height)
    widest = 8 if shape.lane_runs else 4
    digits = math.ceil(32 / widest) + math.ceil(tiles.bit_length() / widest)
    assert names.count("sort_count") == names.count("sort_scatter") == digits
    assert names.count("scan_blocks") == digits + 2
    others = [name for name in names if not name.startswith(("sort", "scan"))]
    assert sorted(set(others)) == sorted(others), "a pass that runs twice"
    assert len(others) <= 11
    assert len(names) <= 11 + 3 * 2 + 5 * digits


def test_bytes_that_cross_over(device: Device, scene: Scene, events: list[Event]) -> None:
    """Inputs, image and gradients once each, and next to nothing else."""
    step(scene, CAMERA, device, sh_degree=DEGREE)
    geometry, harmonics, splat, planes = 4 * (3 + 4 + 3 + 1), 4 * 16 * 3, 4 * 12, 4 * 5
    written = COUNT * (geometry + harmonics) + PIXELS * planes
    read = (PIXELS * planes + COUNT * splat) + COUNT * (splat + 4 * (3 + 4 + 3) + harmonics)
    totals = {kind: sum(event.nbytes for event in events if event.kind == kind) for kind in ("read", "write")}
    assert written <= totals["write"] <= written + 2048
    assert read <= totals["read"] <= read + 256


def test_nothing_grows_in_steady_state(device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """No buffer, texture, kernel or bind group is made for a step like the one before."""
    rasterizer = rasterizer_of(device)
    held, kernels = rasterizer.pool.nbytes, len(device.kernel_cache)
    made: list[str] = []
    for method in ("create_buffer", "create_texture", "create_bind_group", "create_compute_pipeline"):
        original = getattr(type(device.wgpu_device), method)

        def spy(self: Any, *arguments: Any, _name: str = method, _original: Any = original, **options: Any) -> Any:
            made.append(_name)
            return _original(self, *arguments, **options)

        monkeypatch.setattr(type(device.wgpu_device), method, spy)
    for seed in (1, 2):
        step(scene | {"means": scene["means"] + 1e-3 * seed}, CAMERA, device, sh_degree=DEGREE)
    assert made == []
    assert rasterizer.pool.nbytes == held
    assert len(device.kernel_cache) == kernels
