"""A whole training step: the real loop, with the preset `tiny` on the built-in scene."""

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from measure import Timing, Traffic, count, recording, summary
from synthetic import write_synthetic

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.presets import load_config

WARM_UP = 5  # steps that are not counted: kernels are compiled, buffers grow


@dataclass(frozen=True)
class StepReport:
    """step: from one to the next, with everything moving; traffic: of the last one."""

    gaussians: int
    size: int
    step: Timing
    traffic: Traffic


def bench_step(device: Device, repeat: int) -> StepReport:
    """Train for a few steps, before density control begins."""
    config = load_config("tiny", {"schedule.steps": str(WARM_UP + repeat), "schedule.warm_up": "0"})
    assert config.density.start > WARM_UP + repeat, "density control would change what is timed"
    times: list[float] = []
    log_step = Log.step
    with TemporaryDirectory() as folder, recording() as events:
        marks: list[int] = []

        def marked_step(self: Log, *values: Any) -> None:
            log_step(self, *values)
            times.append(time.perf_counter())
            marks.append(len(events))

        dataset = load_dataset(write_synthetic(Path(folder) / "scene"))
        with mock.patch.object(Log, "step", marked_step):
            train(config, dataset, Path(folder) / "run", device=device)
    gaps = [1e3 * (after - before) for before, after in zip(times[WARM_UP - 1 :], times[WARM_UP:], strict=False)]
    size = dataset.train[0].camera.width
    return StepReport(config.points.count, size, summary(gaps), count(events[marks[-2] : marks[-1]]))
