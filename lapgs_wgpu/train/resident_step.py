"""A training step whose parameters, gradients and optimizer stay on the device: one submission, and no wait for it.

What a step tells is read when it is asked for, or two steps later. A step whose values are not finite, or whose
intersections did not fit, changes nothing, and neither does what is in flight behind it (close_guard.wgsl): the host
then mends the cause, and takes these steps again.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.errors import NumericalError
from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.gpu.later import Later, Ring
from lapgs_wgpu.motion.passes.samples import Samples
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.drawing import Drawing
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.ground_truth import AHEAD, GroundTruth
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.motion_losses import even_times, near_time
from lapgs_wgpu.train.nonfinite import Skipped, cause, check_parameters
from lapgs_wgpu.train.resident_parameters import PARTS
from lapgs_wgpu.train.resident_passes import ResidentPasses
from lapgs_wgpu.train.resident_task import ResidentSample, Task
from lapgs_wgpu.train.step_result import Measured, Scheduled
from lapgs_wgpu.train.view_order import Draws

IN_FLIGHT = 2  # steps that are submitted and not waited for
_RING_BYTES = 8192
_OVERFLOW = 1 << 31  # close_guard.wgsl


class _Flying(NamedTuple):
    """A step that was submitted."""

    task: Task
    drawing: Drawing
    later: Later
    result: Pending


class Pending:
    """What a step will have told."""

    def __init__(self, settle: Callable[[], None]) -> None:
        self._settle, self.value = settle, None

    value: Measured | None

    def __call__(self) -> Measured:
        """Wait for the step."""
        while self.value is None:
            self._settle()
        return self.value


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
        self._ring = Ring(scene.device, _RING_BYTES)
        self._flying: deque[_Flying] = deque()
        self._statistics_on_host = True
        self.field_fitted = False
        self.settled = 0
        self.broken: Callable[[int | None], None] = lambda step: None
        self.tell: Callable[[Measured], None] = lambda measured: None
        self.dead_scales = 0.0
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

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self._scene)

    def take(self, scheduled: Scheduled, began: Callable[[], None]) -> Pending:
        """Submit a step, after `make_room`; what it will have told. began: called when it is submitted."""
        task = self._task(scheduled, self._scene.sh_degree)
        self._push()
        if not self._flying:
            self.settled = scheduled.step - 1
        flying = self._submit(task, Pending(self._settle_first))
        self._flying.append(flying)
        began()
        return flying.result

    def _task(self, scheduled: Scheduled, sh_degree: int) -> Task:
        """Draw for a step."""
        step, draws, frequencies = scheduled.step, self._draws, self._learners.frequencies
        before, (view, background), drawn = draws.mark(), draws.next(), draws.mark()
        sample = self._draw(view, background, step, draws.generator, moving=scheduled.moving)
        self._truth.prefetch([view, *draws.coming(AHEAD)])
        rates = self._learners.optimizer.rates_at(step, scheduled.share)
        frequency_rate = frequencies.rate.at(step) if frequencies else 0.0
        time = self._scene.timing(view.time)
        return Task(scheduled, before, drawn, sample, time, sh_degree, rates, frequency_rate)

    def _draw(
        self, view: View, background: Tensor, step: int, generator: torch.Generator, *, moving: bool
    ) -> ResidentSample:
        """Draw what a step, counted from 1, looks at."""
        config, count, t = self._config, self.count, self._scene.timing(view.time)
        red, green, blue = background.tolist()
        sample = ResidentSample(view, (red, green, blue))
        if not moving or not self._passes.moves or step <= config.smoothness.start:
            return sample
        smooth, even = config.smoothness, config.acceleration
        near_count, even_count = round(smooth.share * count), round(even.share * count)
        if near_count and (smooth.static or smooth.temporal):
            near = Samples(near_count, count, *_draw_rows(count, generator), smooth.reach)
            sample = dataclasses.replace(sample, near=near, near_time=near_time(smooth, t, generator))
        left_out = self.field_fitted or step % even.interval or not even.weight or self._time_count < 3
        if even_count and not left_out:
            samples = Samples(even_count, count, *_draw_rows(count, generator))
            sample = dataclasses.replace(sample, even=samples, even_times=even_times(t, self._time_count, generator))
        return sample

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
        flying = self._flying[0]
        words, terms, totals, needed = self._told(flying)
        if not words["guard"]:
            self._passes.rasterizer.grow_on_overflow(flying.drawing, needed)
            self._flying.popleft()
            self.settled = flying.task.scheduled.step
            self.dead_scales = int(words["dead"]) / max(1, 3 * self.count)
            flying.result.value = self._measured(flying.task, terms, totals, None)
            self.tell(flying.result.value)
            return
        behind = self._ground()
        if words["bad"] & _OVERFLOW:
            self._passes.rasterizer.grow_on_overflow(flying.drawing, needed)
            self._again([(each.task, each.result) for each in behind])
            return
        # Not finite. The gradients are gone that were: this step alone once more, behind the closed guard.
        self._passes.word("guard").write(np.array([flying.task.scheduled.step], np.uint32))
        self._told(self._submit(flying.task, flying.result, judged=True))
        gradients = self.parameters.gradients() | self._passes.corrections.gradients()
        with Commands(self._scene.device) as commands:
            self.parameters.clear_gradients(commands)
        self.parameters.steps = dict(flying.task.counts)
        self.to_host()
        try:
            check_parameters(self._learners.parameters())
        except NumericalError:
            self.broken(None)
            raise
        self._passes.word("guard").write(np.zeros(1, np.uint32))
        values = self._terms(flying.task, terms, totals)
        what = cause(values, gradients)
        skipped = Skipped(flying.task.scheduled.step, flying.task.sample.view.name, what)
        flying.result.value = self._measured(flying.task, terms, totals, skipped)
        self.settled = flying.task.scheduled.step
        # No random number was drawn for the sample of a step that is skipped.
        self._draws.go_back(flying.task.drawn)
        for each in behind[1:2]:
            each.task.before = flying.task.drawn
        self.tell(flying.result.value)
        tasks = [self._task(each.task.scheduled, each.task.sh_degree) for each in behind[1:]]
        self._push()
        self._again(list(zip(tasks, [each.result for each in behind[1:]], strict=True)))

    def _ground(self) -> list[_Flying]:
        """All steps in flight, which have changed nothing; none is in flight any more, and the guard is open."""
        behind = list(self._flying)
        self._flying.clear()
        for each in behind[1:]:
            each.later.read()
        self._passes.word("guard").write(np.zeros(1, np.uint32))
        self.parameters.steps = dict(behind[0].task.counts)
        return behind

    def _again(self, tasks: list[tuple[Task, Pending]]) -> None:
        for task, result in tasks:
            self._flying.append(self._submit(task, result))

    def _told(
        self, flying: _Flying
    ) -> tuple[dict[str, np.uint32], NDArray[np.float32], NDArray[np.float32], list[NDArray[np.uint32]]]:
        guard, bad, dead, terms, totals, *needed = flying.later.read()
        return {"guard": guard[0], "bad": bad[0], "dead": dead[0]}, terms, totals, needed

    def _terms(self, task: Task, terms: NDArray[np.float32], totals: NDArray[np.float32]) -> dict[str, float]:
        weights, values = self._passes.weights(task), terms.tolist()
        found = {"l1": weights.l1 * values[0]}
        for name, value in zip(("ssim", "pyramid", "ncc"), values[2:], strict=True):
            if weight := getattr(weights, name):
                found[name] = weight * value
        static, temporal, even, dynamics = totals.tolist()
        if task.sample.near is not None:
            found["smoothness"] = static + temporal
        if task.sample.even is not None:
            found["acceleration"] = even
        if task.scheduled.moving and self._passes.dynamics_loss:
            found["dynamics"] = dynamics
        return found

    def _measured(
        self, task: Task, terms: NDArray[np.float32], totals: NDArray[np.float32], skipped: Skipped | None
    ) -> Measured:
        found = self._terms(task, terms, totals)
        mse = float(terms[1])
        psnr = psnr_of(mse) if math.isfinite(mse) else math.nan
        return Measured(math.fsum(found.values()) if skipped is None else sum(found.values()), psnr, skipped, found)

    def _submit(self, task: Task, result: Pending, *, judged: bool = False) -> _Flying:
        """Submit a step. judged: only up to its gradients, which stay."""
        truth, device = self._truth.on_device(task.sample.view), self._scene.device
        self._passes.check_driver(task)
        task.counts = dict(self.parameters.steps)
        with Commands(device, whole=True) as commands:
            step = self._passes.record(commands, task, truth, judged=judged)
            later = self._ring.record(commands, step.told)
        later.submitted()
        return _Flying(task, step.drawing, later, result)


def _draw_rows(count: int, generator: torch.Generator) -> tuple[int, int]:
    """First row and seed of samples."""
    first, seed = torch.randint(1 << 31, (2,), generator=generator).tolist()
    return first % count, seed
