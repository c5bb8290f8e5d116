"""The device of the kernel tests, in the configuration that the environment variable LAPGS_TEST_DEVICE names.

The tests marked `kernels` hold in each configuration, for example `LAPGS_TEST_DEVICE=gpu-shape pytest -m kernels`.
The Makefile says which configurations `make test` and `make test-all` run.
"""

# Before torch: it tells torch's threads how to wait, which is read once, when torch is imported.
import lapgs_wgpu  # noqa: F401

# isort: split
import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from synthetic import write_synthetic

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.gpu.device import _DEFAULT_LIMITS, Device, _adapters, _matches
from lapgs_wgpu.splat import rasterize as rasterize_module
from lapgs_wgpu.splat.rasterizer import Rasterizer

# What the adapter is taken for, and what it offers instead.
_DEFAULT = {"limits": _DEFAULT_LIMITS | {"max-storage-textures-per-shader-stage": 4}}
CONFIGURATIONS: dict[str, tuple[str | None, dict[str, Any]]] = {
    "default": (None, {}),
    "no-subgroups": (None, {"features": ()}),
    "default-limits": (None, _DEFAULT),
    # Tables in buffers, the GPU shapes of rasterizer, sort and hash gradients.
    "gpu-shape": ("discrete", {}),
    "gpu": ("discrete", _DEFAULT),  # gpu-shape and default-limits at once
}


def open_test_device(configuration: str) -> Device:
    """The adapter that LAPGS_DEVICE names, else the first, in one of the CONFIGURATIONS."""
    kind, offered = CONFIGURATIONS[configuration]
    wanted = os.environ.get("LAPGS_DEVICE", "")
    info, adapter = next(pair for pair in _adapters() if not wanted or _matches(pair[0], wanted))
    offered = {"features": adapter.features, "limits": adapter.limits} | offered
    taken = SimpleNamespace(request_device_sync=adapter.request_device_sync, **offered)
    return Device(taken, dataclasses.replace(info, kind=kind or info.kind))


pytest.register_assert_rewrite("helpers")


def pytest_configure() -> None:
    torch.set_num_threads(1)  # the tensors are small, and the software driver needs the processor


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if os.environ.get("LP_NATIVE_VECTOR_WIDTH") == "512":
        skip = pytest.mark.skip(reason="Mesa's software driver draws no triangles with vectors of 512 bits")
        for item in items:
            if "triangles" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(scope="session")
def configuration() -> str:
    return os.environ.get("LAPGS_TEST_DEVICE", "default")


@pytest.fixture(scope="session")
def device(configuration: str) -> Device:
    """One for all tests, so that each kernel is compiled once."""
    return open_test_device(configuration)


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built-in scene, small. No test changes it."""
    return write_synthetic(tmp_path_factory.mktemp("data") / "scene", size=32, train_views=8, test_views=2)


@pytest.fixture(scope="session")
def dataset(data: Path) -> Dataset:
    return load_dataset(data)


@pytest.fixture(scope="session")
def trained_run(data: Path, dataset: Dataset, device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 36 steps with motion, on `dataset` (helpers/training.configure). No test changes
    it; a test that does copies it first."""
    from helpers.training import configure

    from lapgs_wgpu.run import train

    out = tmp_path_factory.mktemp("runs") / "trained"
    train(configure(data__path=str(data)), dataset, out, device=device)
    return out


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Callable[[Rasterizer], Rasterizer]:
    """Makes `rasterize` draw with the given Rasterizer until the test ends."""

    def replace(rasterizer: Rasterizer) -> Rasterizer:
        monkeypatch.setattr(rasterize_module, "rasterizer_of", lambda device: rasterizer)
        return rasterizer

    return replace
