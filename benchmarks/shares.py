"""Where a training step's time goes: the real loop with a preset, on the built-in scene."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from measure import Timing, summary
from synthetic import write_synthetic
from timestamps import Profile

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu import array as array_module
from lapgs_wgpu.gpu.array import Buffer
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields import hash_encoder
from lapgs_wgpu.run import train
from lapgs_wgpu.train import exchange_step
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.optimizer import FrequencyOptimizer, Optimizer
from lapgs_wgpu.train.presets import load_config

VIEWS = 8
WARM_UP = 10  # steps that are not counted: kernels are compiled, and each image is decoded
RASTER, ENCODER, LOSSES = "rasterizer", "hash encoder", "image losses"
TRANSFERS, OPTIMISER, REST = "transfers", "optimizer", "torch: decoder, activations, their gradients"
ORDER = (RASTER, ENCODER, LOSSES, TRANSFERS, OPTIMISER, REST)


def bench_shares(device: Device, preset: str, repeat: int, gaussians: int, size: int) -> dict[str, Timing]:
    """Milliseconds a step of each part, and under "step" of the whole. size: of the images, pixels.

    Kernels by the device's timestamps. Transfers are the host's copies, timed when the device has finished, and the
    device's own between buffers and textures.
    """
    steps = WARM_UP + repeat
    schedule = {"schedule.steps": str(steps), "schedule.warm_up": "0", "density.start": str(steps)}
    config = load_config(preset, schedule | {"points.count": str(gaussians)})
    clock = _Clock(device)
    log_step = Log.step

    def end_of_step(self: Log, *values: Any) -> None:
        log_step(self, *values)
        clock.end_step()

    with TemporaryDirectory() as folder, clock.running(), mock.patch.object(Log, "step", end_of_step):
        scene = write_synthetic(Path(folder) / "scene", size=size, train_views=VIEWS, test_views=1)
        train(config, load_dataset(scene), Path(folder) / "run", device=device)
    counted = clock.steps[WARM_UP:steps]
    return {name: summary([step[name] for step in counted]) for name in (*ORDER, "step")}


class _Clock:
    """Adds up the times of a step by part."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._profile = Profile(device)
        self._now: dict[str, float] = defaultdict(float)
        self._start = time.perf_counter()
        self.steps: list[dict[str, float]] = []

    def end_step(self) -> None:
        self._collect()
        now = time.perf_counter()
        step = self._now | {"step": 1e3 * (now - self._start)}
        step[REST] = step["step"] - sum(step.get(name, 0.0) for name in ORDER[:-1])
        self.steps.append(defaultdict(float, step))
        self._now, self._start = defaultdict(float), time.perf_counter()

    def _collect(self) -> None:
        """Wait for the device and take in its kernels; what it did besides are copies from buffers to textures."""
        start = time.perf_counter()
        kernels = self._profile.read()
        for name, milliseconds in kernels:
            part = ENCODER if name.startswith("hashgrid") else LOSSES if name.startswith("loss_") else RASTER
            self._now[part] += milliseconds
        waited = 1e3 * (time.perf_counter() - start) - sum(milliseconds for _, milliseconds in kernels)
        self._now[TRANSFERS] += max(0.0, waited)

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            result = function(*arguments, **options)
            self._now[part] += 1e3 * (time.perf_counter() - start)
            return result

        return run

    @contextmanager
    def running(self) -> Iterator[None]:
        read_all = array_module.read_all
        copy = self._timed(TRANSFERS, read_all)

        def read_when_done(arrays: Any) -> Any:
            if not any(array.buffer.label == "timestamps to read" for array in arrays):
                self._collect()
                return copy(arrays)
            return read_all(arrays)

        patches = [
            mock.patch.object(Buffer, "write", self._timed(TRANSFERS, Buffer.write)),
            mock.patch.object(Optimizer, "step", self._timed(OPTIMISER, Optimizer.step)),
            mock.patch.object(FrequencyOptimizer, "step", self._timed(OPTIMISER, FrequencyOptimizer.step)),
            *(
                mock.patch.object(module, "read_all", read_when_done)
                for module in (array_module, hash_encoder, exchange_step)
            ),
        ]
        for patch in patches:
            patch.start()
        try:
            with self._profile.running():
                yield
        finally:
            for patch in patches:
                patch.stop()
