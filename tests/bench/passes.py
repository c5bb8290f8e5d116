"""The time of each pass by the device's own clock, beside the least that the device's ceilings allow."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from unittest import mock

from ceilings import KERNELS, CeilingKernels, Ceilings
from measure import Timing, summary
from work import Work

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.profile import Profile


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
    """By shader, in the order of the passes; empty where the adapter has no timestamps, and ceilings is None then."""

    ceilings: Ceilings | None
    passes: dict[str, PassTime]


def time_passes(
    device: Device, function: Callable[[], object], work: dict[str, Work], kernels: CeilingKernels | None, repeat: int
) -> PassTimes:
    """Time the passes that `function` submits, and the ceilings, taking turns, since other work may run meanwhile."""
    if kernels is None:
        return PassTimes(None, {})
    profile = Profile(device)
    runs: list[dict[str, list[float]]] = []
    prepare = Commands.__init__

    def profiled(commands: Commands, device: Device, other: Profile | None = None) -> None:
        prepare(commands, device, other or profile)

    for _ in range(2 + repeat):
        kernels.run(profile)
        with mock.patch.object(Commands, "__init__", profiled):
            function()
        run: dict[str, list[float]] = defaultdict(list)
        for shader, milliseconds in profile.read():
            run[shader].append(milliseconds)
        runs.append(run)
    runs = runs[2:]
    times = {shader: [sum(run[shader]) for run in runs] for shader in runs[0]}
    ceilings = kernels.ceilings({name: summary(times.pop(name)) for name in KERNELS})
    found = {}
    for shader, milliseconds in times.items():
        timing, todo = summary(milliseconds), work.get(shader)
        ceiling = None if todo is None else ceilings.milliseconds(todo)
        share = None if ceiling is None else ceiling / timing.median
        found[shader] = PassTime(len(runs[0][shader]), timing, todo, ceiling, share)
    return PassTimes(ceilings, found)
