"""The time of each pass, beside the least that the device's ceilings allow."""

from __future__ import annotations

import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from unittest import mock

from ceilings import KERNELS, CeilingKernels, Ceilings
from measure import Timing, summary
from work import Work

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.native import Encoder
from lapgs_wgpu.gpu.profile import Profile

COPIES = "copies to textures"


@dataclass(frozen=True)
class PassTime:
    """All dispatches of one shader together.

    ceiling: the least milliseconds for the work; share: of that in the time. None where the work is not counted.
    """

    dispatches: int
    milliseconds: Timing
    work: Work | None
    ceiling: float | None
    share: float | None


@dataclass(frozen=True)
class PassTimes:
    """By shader, in the order of the passes."""

    ceilings: Ceilings
    passes: dict[str, PassTime]


Times = list[tuple[str, float]]  # shader and milliseconds of each dispatch, in order
Clock = Callable[[Device], AbstractContextManager[Times]]


@contextmanager
def by_timestamps(device: Device) -> Iterator[Times]:
    """A list that holds, afterwards, what the device's own clock says of all that was submitted."""
    profile, times = Profile(device), Times()
    prepare = Commands.__init__

    def profiled(commands: Commands, device: Device, other: Profile | None = None) -> None:
        prepare(commands, device, other or profile)

    with mock.patch.object(Commands, "__init__", profiled):
        yield times
    times += profile.read()


@contextmanager
def by_processor_time(device: Device) -> Iterator[Times]:
    """The same of a CPU device by processor time over the number of processors, which other work on the machine hardly
    changes. Each dispatch is submitted and waited for alone, and so are the copies of its tables to textures (COPIES).
    """
    times, done = Times(), DeviceArray.empty(device, "done", (4,), "uint32")
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    dispatch_grid = Commands.dispatch_grid

    def submit(commands: Commands) -> float:
        commands.clear(done)
        encoder, commands._encoder = commands._encoder, Encoder(device.wgpu_device)
        encoder.end_pass()
        recorded = encoder.wgpu_encoder.finish()
        start = time.process_time()
        device.queue.submit([recorded])
        done.read()
        return 1e3 * (time.process_time() - start) / processors

    empty = statistics.median(submit(Commands(device)) for _ in range(9))  # what asking for nothing takes

    def alone(commands: Commands, kernel: Kernel, groups: tuple[int, int] | DeviceArray, **arrays: DeviceArray) -> None:
        if not isinstance(groups, tuple) or min(groups) > 0:
            for name, texels in kernel.textures.items():
                commands._texture(arrays[name], texels)
            times.append((COPIES, max(0.0, submit(commands) - empty)))
            dispatch_grid(commands, kernel, groups, **arrays)
            times.append((kernel.name, max(0.0, submit(commands) - empty)))

    with mock.patch.object(Commands, "dispatch_grid", alone):
        yield times


class Meter:
    """Times passes by a clock, and the device's ceilings beside them, taking turns: other work may run besides."""

    def __init__(self, device: Device, clock: Clock = by_timestamps) -> None:
        self._device, self._clock, self._kernels = device, clock, CeilingKernels(device)

    def __call__(self, function: Callable[[], object], work: dict[str, Work], repeat: int) -> PassTimes:
        """The passes that `function` submits. work: of all dispatches of a shader together."""
        runs: list[dict[str, list[float]]] = []
        for _ in range(2 + repeat):
            with self._clock(self._device) as times:
                self._kernels.run()
                function()
            run: dict[str, list[float]] = defaultdict(list)
            for shader, milliseconds in times:
                run[shader].append(milliseconds)
            runs.append(run)
        runs = runs[2:]
        summaries = {shader: summary([sum(run[shader]) for run in runs]) for shader in runs[0]}
        ceilings = self._kernels.ceilings({name: summaries.pop(name) for name in KERNELS})
        passes = {}
        for shader, milliseconds in summaries.items():
            todo = work.get(shader)
            ceiling = None if todo is None else ceilings.milliseconds(todo)
            # A clock of processor time may not move at all in a short pass.
            share = None if ceiling is None or not milliseconds.median else ceiling / milliseconds.median
            passes[shader] = PassTime(len(runs[0][shader]), milliseconds, todo, ceiling, share)
        return PassTimes(ceilings, passes)
