"""A training step whose parameters, gradients and optimizer stay on the device: one submission, and no wait for it.

What a step tells is read when it is asked for, or two steps later. A step whose values are not finite, or whose
intersections did not fit, changes nothing, and neither does what is in flight behind it (close_guard.wgsl): the host
then mends the cause, and takes these steps again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.errors import NumericalError
from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.later import Later
from lapgs_wgpu.motion.passes.samples import Samples
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.drawing import Drawing
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.ground_truth import AHEAD, GroundTruth
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.motion_losses import compared_counts, even_times, near_time
from lapgs_wgpu.train.nonfinite import Skipped, cause, check_parameters
from lapgs_wgpu.train.resident_parameters import FREQUENCIES, PARTS
from lapgs_wgpu.train.resident_passes import ResidentPasses, Task
from lapgs_wgpu.train.step_result import Measured, Scheduled
from lapgs_wgpu.train.view_order import Draws

IN_FLIGHT = 2  # steps that are submitted and not waited for
_OVERFLOW = 1 << 31  # close_guard.wgsl


class Flying:
    """A step that was submitted; called, it waits, and gives what the step told. later: what that is."""

    drawing: Drawing
    later: Later
    value: Measured | None = None

    def __init__(self, task: Task, settle: Callable[[], None]) -> None:
        self.task, self._settle = task, settle

    def __call__(self) -> Measured:
        while self.value is None:
            self._settle()
        return self.value


class _Told(NamedTuple):
    """What a step tells. guard: 0, or the step at which it was closed; bad: why; terms, totals: of the
    losses of the image, and of motion; needed: of each band's intersections."""

    guard: int
    bad: int
    terms: NDArray[np.float32]
    totals: NDArray[np.float32]
    needed: list[NDArray[np.uint32]]


class ResidentStep:
    """Takes the steps of a training whose parameters stay on the device.

    settled: the last step that was waited for. broken: called with it where an error ends the steps behind it, and with
    None where the parameters themselves are not finite.
    tell: called with what each step tells, in their order.
    """

    def __init__(
        self,
        config: Config,
        scene: Scene4D,
        learners: Learners,
        density: DensityControl,
        truth: GroundTruth,
        draws: Draws,
        time_count: int,
    ) -> None:
        self._config, self._scene, self._learners, self._density = config, scene, learners, density
        self._truth, self._draws, self._time_count = truth, draws, time_count
        self._passes = ResidentPasses(config, scene, learners)
        self.parameters = self._passes.parameters
        self._flying: deque[Flying] = deque()
        self._statistics_on_host = True
        self.settled = 0
        self.broken: Callable[[int | None], None] = lambda step: None
        self.tell: Callable[[Measured], None] = lambda measured: None
        scene.on_access, scene.on_device = self.to_host, self.at
        learners.optimizer.on_access = self.to_rest
        learners.on_access = self.corrections_to_host

    # Between steps ---------------------------------------------------------------------------------------------------

    def to_host(self, *parts: str) -> None:
        """Wait for all steps, and make the scene's tensors of some parts, of all if none is named, the newest ones."""
        self.settle()
        self.parameters.pull_values(*parts)
        if "gaussians" in (parts or PARTS) and not self._statistics_on_host:
            self._statistics_on_host = True
            seen = torch.from_numpy(self._passes.seen().read())
            for target, column in zip(vars(self._density.statistics).values(), seen.T, strict=True):
                target.copy_(column)

    def corrections_to_host(self) -> None:
        """Wait for all steps, and make the host's corrections of cameras and colors the newest ones."""
        self.settle()
        self._passes.corrections.pull()

    def to_rest(self, *parts: str) -> None:
        """The same with the optimizers' state."""
        self.to_host(*parts)
        self.parameters.pull_state(*parts)

    def at(self, t: float) -> Gaussians[Tensor]:
        """The scene's Gaussians at a time of the field, from the newest parameters, which are not given out."""
        self.settle()
        self.parameters.push_values()
        now = self._passes.at(t, self._scene.sh_degree)
        tensors = [torch.from_numpy(array) for array in read_all(list(now.arrays().values()))]
        return Gaussians(**dict(zip(now.arrays(), tensors, strict=True)), antialiased=now.antialiased)

    def settle(self) -> None:
        """Wait for all steps."""
        while self._flying:
            self._settle_first()

    def make_room(self) -> None:
        """Wait until one more step may be in flight. Nothing may have been drawn for it yet."""
        while len(self._flying) >= IN_FLIGHT:
            self._settle_first()

    def take(self, scheduled: Scheduled, began: Callable[[], None]) -> Flying:
        """Submit a step, after `make_room`; what it will have told. began: called when it is submitted."""
        task = self._task(scheduled, self._scene.sh_degree)
        self._push()
        if not self._flying:
            self.settled = scheduled.step - 1
        flying = self._submit(Flying(task, self._settle_first))
        self._flying.append(flying)
        began()
        return flying

    def _task(self, scheduled: Scheduled, sh_degree: int) -> Task:
        step, draws, frequencies = scheduled.step, self._draws, self._learners.frequencies
        before, view, drawn = draws.mark(), draws.next(), draws.mark()
        rates = self._learners.optimizer.rates_at(step, scheduled.share)
        if frequencies is not None:
            rates[FREQUENCIES] = frequencies.rate.at(step)
        task = Task(scheduled, before, drawn, view, self._scene.timing(view.time), sh_degree, rates)
        if self._passes.moves:
            self._draw(task, draws.generator)
        self._truth.prefetch([view, *draws.coming(AHEAD)])
        return task

    def _draw(self, task: Task, generator: torch.Generator) -> None:
        config, count, fitted = self._config, len(self._scene), self._learners.field_fitted > 0
        near, even = compared_counts(config, task.scheduled, count, self._time_count, fitted=fitted)
        if near:
            task.near = Samples(near, count, _draw_seed(generator), config.smoothness.reach)
            task.near_time = near_time(config.smoothness, task.time, generator)
        if even:
            task.even = Samples(even, count, _draw_seed(generator))
            task.even_times = even_times(task.time, self._time_count, generator)

    def _push(self) -> None:
        self.parameters.push()
        self._passes.corrections.push()
        if self._statistics_on_host:
            self._statistics_on_host = False
            columns = [values.numpy(force=True) for values in vars(self._density.statistics).values()]
            self._passes.seen().write(np.stack(columns, axis=1).astype(np.float32))

    # A step's end ----------------------------------------------------------------------------------------------------

    def _settle_first(self) -> None:
        """Wait for the step that was submitted first, and mend what it asks for.

        After an error the parameters are those after the step `settled`, which `broken` is called with.
        """
        tasks = [each.task for each in self._flying]
        try:
            self._settle()
        except Exception:
            self._flying.clear()
            for task in [task for task in tasks if task.scheduled.step == self.settled + 1]:
                self._draws.go_back(task.before)
                self._scene.sh_degree = task.sh_degree
            self.broken(self.settled)
            raise

    def _settle(self) -> None:
        first = self._flying[0]
        told = self._told(first)
        if not told.guard:
            self._passes.rasterizer.grow_on_overflow(first.drawing, told.needed)
            self._flying.popleft()
            self._tell(first, told, "")
            return
        behind = self._ground()
        if told.bad & _OVERFLOW:
            self._passes.rasterizer.grow_on_overflow(first.drawing, told.needed)
            self._flying.extend(self._submit(each) for each in behind)
            return
        # Not finite. The gradients are gone that were: this step alone once more, behind the closed guard.
        self._passes.word("guard").write(np.array([first.task.scheduled.step], np.uint32))
        self._told(self._submit(first, judged=True))
        gradients = self.parameters.gradients() | self._passes.corrections.gradients()
        with Commands(self._scene.device) as commands:
            self.parameters.clear_gradients(commands)
        self.parameters.steps = dict(first.task.counts)
        self.to_host()
        try:
            check_parameters(self._learners.parameters())
        except NumericalError:
            self.broken(None)
            raise
        self._passes.word("guard").write(np.zeros(1, np.uint32))
        # No random number was drawn for the samples of a step that is skipped.
        self._draws.go_back(first.task.drawn)
        for each in behind[1:2]:
            each.task.before = first.task.drawn
        self._tell(first, told, cause(self._terms(first.task, told), gradients))
        for each in behind[1:]:
            each.task = self._task(each.task.scheduled, each.task.sh_degree)
        self._push()
        self._flying.extend(self._submit(each) for each in behind[1:])

    def _ground(self) -> list[Flying]:
        """All steps in flight, which have changed nothing; none is in flight any more, and the guard is open."""
        behind = list(self._flying)
        self._flying.clear()
        for each in behind[1:]:
            each.later.read()
        self._passes.word("guard").write(np.zeros(1, np.uint32))
        self.parameters.steps = dict(behind[0].task.counts)
        return behind

    def _told(self, flying: Flying) -> _Told:
        guard, bad, terms, totals, *needed = flying.later.read()
        return _Told(int(guard[0]), int(bad[0]), terms, totals, needed)

    def _terms(self, task: Task, told: _Told) -> dict[str, float]:
        weights, values = self._passes.weights(task), told.terms.tolist()
        found = {"l1": weights.l1 * values[0]}
        for name, value in zip(("ssim", "pyramid", "ncc"), values[2:], strict=True):
            if weight := getattr(weights, name):
                found[name] = weight * value
        static, temporal, even, dynamics = told.totals.tolist()
        if task.near is not None:
            found["smoothness"] = static + temporal
        if task.even is not None:
            found["acceleration"] = even
        if task.scheduled.moving and self._passes.dynamics_loss:
            found["dynamics"] = dynamics
        return found

    def _tell(self, flying: Flying, told: _Told, what: str) -> None:
        """A step is settled. what: was not finite in it, for which it was skipped."""
        task, mse = flying.task, float(told.terms[1])
        self.settled, found = task.scheduled.step, self._terms(task, told)
        psnr, loss = psnr_of(mse) if math.isfinite(mse) else math.nan, sum(found.values())
        skipped = Skipped(self.settled, task.view.name, what) if what else None
        flying.value = Measured(loss if skipped else math.fsum(found.values()), psnr, skipped, found)
        self.tell(flying.value)

    def _submit(self, flying: Flying, *, judged: bool = False) -> Flying:
        """Submit a step. judged: only up to its gradients, which stay."""
        task, truth = flying.task, self._truth.on_device(flying.task.view)
        self._passes.check_driver(task)
        task.counts = dict(self.parameters.steps)
        with Commands(self._scene.device, whole=True) as commands:
            flying.drawing, told = self._passes.record(commands, task, truth, judged=judged)
            flying.later = Later(commands, told)
        flying.later.submitted()
        return flying


def _draw_seed(generator: torch.Generator) -> int:
    return int(torch.randint(1 << 31, (), generator=generator))
