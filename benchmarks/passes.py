"""The time of each pass, beside the least that the device's ceilings allow."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from ceilings import KERNELS, CeilingKernels, Ceilings
from measure import Timing, summary
from timestamps import Profile
from work import Work

from lapgs_wgpu.gpu.device import Device


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


@contextmanager
def by_timestamps(device: Device) -> Iterator[Times]:
    """A list that holds, afterwards, what the device's own clock says of all that was submitted."""
    profile, times = Profile(device), Times()
    with profile.running():
        yield times
    times += profile.read()


class Meter:
    """Times passes by the device's timestamps, and the device's ceilings in turns with them: other work may run."""

    def __init__(self, device: Device) -> None:
        self._device, self._kernels = device, CeilingKernels(device)

    def __call__(self, function: Callable[[], object], work: dict[str, Work], repeat: int) -> PassTimes:
        """The passes that `function` submits. work: of all dispatches of a shader together."""
        runs: list[dict[str, list[float]]] = []
        for _ in range(2 + repeat):
            with by_timestamps(self._device) as times:
                self._kernels.run()
                function()
            run: dict[str, list[float]] = defaultdict(list)
            for shader, time in times:
                run[shader].append(time)
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
