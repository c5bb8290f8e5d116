"""How much a training step asks of the device: dispatches, read-backs, bytes that cross over."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from helpers.scenes import Scene, oblique_camera, random_scene
from helpers.scenes import step as torch_step
from helpers.stages import watch
from helpers.training import configure
from wgpu.backends.wgpu_native import GPUBuffer, GPUQueue

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.gpu import array as array_module
from lapgs_wgpu.gpu import native
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.radix_sort import FEW_RUNS, runs
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.exchange_step import render_loss
from lapgs_wgpu.train.ground_truth import upload_rgba
from lapgs_wgpu.train.image_loss import image_loss_of
from lapgs_wgpu.train.trainer import Trainer

pytestmark = pytest.mark.kernels

COUNT, CAMERA, DEGREE = 500, oblique_camera(101, 61), 2
PIXELS, HARMONICS = CAMERA.width * CAMERA.height, (DEGREE + 1) ** 2
WEIGHTS = LossWeights(0.8, 0.2, pyramid=0.2, ncc=0.05)


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
    write_buffer, read_buffer = GPUQueue.write_buffer, GPUQueue.read_buffer

    def mapping(device: Any, buffer: GPUBuffer, offset: int, nbytes: int) -> Any:
        seen.append(Event("read", buffer.label, nbytes))
        return native.Mapping(device, buffer, offset, nbytes)

    def writing(self: GPUQueue, buffer: GPUBuffer, offset: int, data: Any, *rest: Any) -> Any:
        seen.append(Event("write", buffer.label, memoryview(data).nbytes))
        return write_buffer(self, buffer, offset, data, *rest)

    def reading(self: GPUQueue, *arguments: Any) -> Any:
        raise AssertionError("queue.read_buffer is a hundred times slower than mapping")

    monkeypatch.setattr(array_module, "Mapping", mapping)
    monkeypatch.setattr(GPUQueue, "write_buffer", writing)
    monkeypatch.setattr(GPUQueue, "read_buffer", reading)
    assert read_buffer is not GPUQueue.read_buffer
    return seen


@pytest.fixture(scope="module")
def scene(device: Device) -> Scene:
    """Drawn once before, so that all buffers have their size."""
    scene = random_scene(COUNT, 1, sh=HARMONICS)
    torch_step(scene, CAMERA, device, sh_degree=DEGREE)
    return scene


@pytest.fixture(scope="module")
def truth(device: Device, scene: Scene) -> DeviceArray:
    """The ground truth of a step that was taken before."""
    truth = upload_rgba(device, np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    step(scene, truth, device)
    return truth


def step(scene: Scene, truth: DeviceArray, device: Device) -> None:
    """A training step: forward, losses, backward."""
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    gaussians = Gaussians(sh=leaves.pop("colors"), **leaves)
    render_loss(gaussians, CAMERA, truth, torch.zeros(3), WEIGHTS, device).loss.backward()


def waits(events: list[Event]) -> int:
    kinds = [event.kind for event in events]
    return sum(a == "read" and b != "read" for a, b in zip(kinds, [*kinds[1:], ""], strict=True))


def totals(events: list[Event]) -> dict[str, int]:
    return {kind: sum(event.nbytes for event in events if event.kind == kind) for kind in ("read", "write")}


def test_one_read_back_a_step(device: Device, scene: Scene, truth: DeviceArray, events: list[Event]) -> None:
    """After the last dispatch: gradients, what density control needs, losses, and whether the buffers sufficed. Inputs
    and gradients cross once each, and next to nothing else: neither images nor their gradients nor ground truth."""
    step(scene, truth, device)
    assert waits(events) == 1
    geometry, harmonics, splat = 4 * (3 + 4 + 3 + 1), 4 * HARMONICS * 3, 4 * 12
    written = COUNT * (geometry + harmonics)
    read = COUNT * splat + COUNT * (splat + 4 * (3 + 4 + 3) + harmonics)
    assert written <= totals(events)["write"] <= written + 2048
    assert read <= totals(events)["read"] <= read + 256
    last_dispatch = max(i for i, event in enumerate(events) if event.kind == "dispatch")
    assert not [event for event in events[:last_dispatch] if event.kind == "read"]


def test_dispatches_a_step(device: Device, scene: Scene, truth: DeviceArray, events: list[Event]) -> None:
    """By the plan: what a sort needs follows from the width of its digits, all else is counted."""
    step(scene, truth, device)
    names = [event.name for event in events if event.kind == "dispatch"]
    shape = rasterizer_of(device).config
    tiles = math.ceil(CAMERA.width / shape.tile_width) * math.ceil(CAMERA.height / shape.tile_height)
    widest = 8 if shape.lane_runs else 4
    sorts = {
        COUNT: math.ceil(32 / widest),
        rasterizer_of(device).plans.now.capacity: math.ceil(tiles.bit_length() / widest),
    }
    digits = sum(sorts.values())
    assert names.count("sort_count") == names.count("sort_scatter") == digits
    # Of few owners, the counters are added up without a scan.
    scans = 2 + sum(each for capacity, each in sorts.items() if shape.lane_runs and runs(capacity) > FEW_RUNS)
    assert names.count("scan_apply") == scans
    # Those over Gaussians have one block; those of a sort more where other tests left a large capacity.
    assert names.count("scan_reduce") <= scans - 2
    pyramid = [name for name in names if name.startswith("loss_pyramid")]
    assert len(pyramid) == 3 + 3 + 4
    others = [name for name in names if not name.startswith(("sort", "scan", "loss_pyramid"))]
    assert sorted(set(others)) == sorted(others), "a pass that runs twice"
    losses = [name for name in others if name.startswith("loss")]
    assert len(losses) <= 8
    assert len(others) - len(losses) <= 11
    assert len(names) - len(losses) - len(pyramid) <= 11 + scans + 2 * digits


@pytest.mark.parametrize("method", ["laplacian", "static"])
def test_a_resident_step_is_one_submission_and_waits_for_nothing(
    device: Device, dataset: Dataset, events: list[Event], monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    """Nor does it move more than a few kilobytes between host and device."""
    submitted, submit = [], GPUQueue.submit
    monkeypatch.setattr(GPUQueue, "submit", lambda self, buffers: submitted.append(1) or submit(self, buffers))
    config = dataclasses.replace(configure(method, schedule__warm_up="0", density__start="100"), step_place="resident")
    with Trainer(config, dataset, device) as trainer:
        for _ in range(len(dataset.train) + 1):  # in which the images cross, too
            trainer.step()
        trainer._resident.settle()
        events.clear()
        submitted.clear()
        for _ in range(2):
            trainer.step()
        assert len(submitted) == 2
        assert waits(events) == 0
        assert totals(events)["write"] < 2 * 8192


def test_nothing_grows_in_steady_state(
    device: Device, scene: Scene, truth: DeviceArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No buffer, texture, kernel or bind group is made for a step like the one before."""
    pools = (rasterizer_of(device).pool, image_loss_of(device).pool)
    torch_step(scene, CAMERA, device, sh_degree=DEGREE)
    held, kernels = [pool.nbytes for pool in pools], len(device.kernel_cache)
    made: list[str] = []
    for method in ("create_buffer", "create_texture", "create_bind_group", "create_compute_pipeline"):
        original = getattr(type(device.wgpu_device), method)

        def spy(self: Any, *arguments: Any, _name: str = method, _original: Any = original, **options: Any) -> Any:
            made.append(_name)
            return _original(self, *arguments, **options)

        monkeypatch.setattr(type(device.wgpu_device), method, spy)
    for seed in (1, 2):
        moved = scene | {"means": scene["means"] + 1e-3 * seed}
        step(moved, truth, device)
        torch_step(moved, CAMERA, device, sh_degree=DEGREE)
    assert made == []
    assert [pool.nbytes for pool in pools] == held
    assert len(device.kernel_cache) == kernels
