"""What a step costs its host: the real loop in the shapes that graphics cards get, on a card that takes no time.

Every dispatch has no workgroups. What is left is what the host does, and what the driver takes to be told. The same
loop on the card as it is stands beside it.
"""

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from measure import Timing, recording, summary
from synthetic import write_synthetic
from wgpu.backends.wgpu_native import GPUQueue

from lapgs_wgpu import Trainer
from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu import native
from lapgs_wgpu.gpu.device import Device, _adapters
from lapgs_wgpu.train.presets import load_config

CASES = {  # Gaussians and longer side of the images, pixels
    "tiny": (10_000, 200),
    "dnerf-400": (25_000, 400),
    "dnerf": (50_000, 800),
}
WARM_UP, VIEWS = 6, 4


@dataclass(frozen=True)
class HostReport:
    """Of a step in which everything moves, in the mean but for its milliseconds: submissions; waits for what was just
    submitted; bytes up and down."""

    gaussians: int
    size: int
    step: Timing
    submissions: float
    waits: float
    up: float
    down: float


def null_device() -> Device:
    """The first adapter, taken for a graphics card."""
    info, adapter = _adapters()[0]
    return Device(adapter, replace(info, kind="discrete"))


@contextmanager
def no_time() -> Iterator[None]:
    """Every dispatch has no workgroups."""
    play = native.play

    def nothing(encoder: Any, commands: list[native.Command]) -> None:
        play(encoder, [(*each[:3], 0, 1) if each[0] == "dispatch" else each for each in commands])

    with mock.patch.object(native, "play", nothing):
        yield


def bench_host(device: Device, preset: str, repeat: int, step: str = "auto", *, null: bool = True) -> HostReport:
    """Steps of a training by a preset, on the built-in scene; discovery and density control are left out."""
    count, size = CASES[preset]
    keys = {"points.count": str(count), "schedule.warm_up": "0", "discovery.enabled": "false", "step_place": step}
    keys |= {"density.start": "1000000", "density.stop": "1000001", "data.size": "0", "timing.refine": "false"}
    config = load_config(preset, keys)
    submit, submissions = GPUQueue.submit, [0]

    def counted(self: GPUQueue, buffers: list[object]) -> None:
        submissions[0] += 1
        submit(self, buffers)

    with (
        TemporaryDirectory() as folder,
        no_time() if null else nullcontext(),
        mock.patch.object(GPUQueue, "submit", counted),
    ):
        dataset = load_dataset(write_synthetic(Path(folder), size=size, train_views=VIEWS, test_views=1))
        with Trainer(config, dataset, device) as trainer:
            for _ in range(WARM_UP):
                trainer.step()
            marks = [time.perf_counter()]
            for _ in range(repeat):
                last = trainer.step()
                marks.append(time.perf_counter())
            assert last.loss >= 0  # waits for all of them
            marks[-1] = time.perf_counter()
            before = submissions[0]
            with recording() as events:
                for _ in range(repeat):
                    trainer.step()
            submitted = submissions[0] - before
    gaps = [1e3 * (b - a) for a, b in itertools.pairwise(marks)]
    kinds = {kind: [event for event in events if event.kind == kind] for kind in ("read", "write")}
    return HostReport(
        count,
        size,
        summary(gaps),
        submitted / repeat,
        len(kinds["read"]) / repeat,
        sum(event.nbytes for event in kinds["write"]) / repeat,
        sum(event.nbytes for event in kinds["read"]) / repeat,
    )
