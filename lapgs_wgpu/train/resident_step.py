"""A training step whose parameters, gradients and optimizer stay on the device: one submission, and no wait for it.

What a step tells is read when it is asked for, or two steps later. A step whose values are not finite, or whose
intersections did not fit, changes nothing, and neither does what is in flight behind it (close_guard.wgsl): the host
then mends the cause, and submits these steps again.
"""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.errors import NumericalError
from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.gpu.kernel import Commands, Later
from lapgs_wgpu.motion.passes.samples import Samples
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.ground_truth import Draws
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.motion_losses import compared_counts, even_times, near_time
from lapgs_wgpu.train.optimizer import rate_at
from lapgs_wgpu.train.resident_parameters import FREQUENCIES, PARTS
from lapgs_wgpu.train.resident_passes import ResidentPasses, Task
from lapgs_wgpu.train.step_result import Measured, Scheduled, Skipped, cause, check_parameters

IN_FLIGHT = 2  # steps that are submitted and not waited for
_OVERFLOW = 1 << 31  # close_guard.wgsl


class ResidentStep:
    """Takes the steps of a training whose parameters stay on the device.

    roll_back_to: called with the last finished step where an error ends those behind it, and with None where the
    parameters themselves are not finite. on_measured: called with what each step has measured, in their order.
    """

    def __init__(
        self,
        learners: Learners,
        density: DensityControl,
        draws: Draws,
        roll_back_to: Callable[[int | None], None],
        on_measured: Callable[[Measured], None],
    ) -> None:
        self._learners, self._density, self._draws = learners, density, draws
        self._roll_back_to, self._on_measured = roll_back_to, on_measured
        self._scene = scene = learners.scene
        self._passes = ResidentPasses(learners)
        self.parameters = self._passes.parameters
        self._flying: deque[Task] = deque()
        self._ring: list[Any] = []
        scene.on_access, scene.newest_at = self.to_host, self.at
        learners.optimizer.on_access = partial(self.to_host, state=True)
        learners.on_access = self.corrections_to_host

    # Between steps ---------------------------------------------------------------------------------------------------

    def to_host(self, *parts: str, state: bool = False) -> None:
        """Wait for all steps, and make the scene's tensors of some parts, of all if none is named, the newest ones.
        state: the optimizers' state of them, too."""
        parts = parts or PARTS
        self.settle()
        if "gaussians" in set(parts) - self.parameters.values_on_host:
            seen = torch.from_numpy(self._passes.seen().read())
            for target, column in zip(vars(self._density.statistics).values(), seen.T, strict=True):
                target.copy_(column)
        self.parameters.pull(parts, state=state)

    def corrections_to_host(self) -> None:
        """Wait for all steps, and make the host's corrections of cameras and colors the newest ones."""
        self.settle()
        self._passes.corrections.pull()

    def at(self, t: float) -> Gaussians[Tensor]:
        """The scene's Gaussians at a time of the field, from the newest parameters, which are not given out."""
        self.settle()
        self.parameters.push_values()
        now = self._passes.at(t, self._scene.sh_degree)
        tensors = [torch.from_numpy(array) for array in read_all(list(now.arrays().values()))]
        return Gaussians(*tensors, antialiased=now.antialiased)

    def settle(self, left: int = 0) -> None:
        """Wait until no more than `left` steps are in flight."""
        while len(self._flying) > left:
            self._finish_first_or_roll_back()

    def take(self, scheduled: Scheduled, began: Callable[[], None]) -> Callable[[], Measured]:
        """Submit a step, before which at most IN_FLIGHT - 1 are in flight. Returns a function that waits for what the
        step tells. began: called when it is submitted."""
        task = self._task(scheduled)
        self._flying.append(self._submit(task))
        began()

        def measured() -> Measured:
            while task.measured is None:
                self._finish_first_or_roll_back()
            return task.measured

        return measured

    def _task(self, scheduled: Scheduled) -> Task:
        learners, config, times = self._learners, self._learners.config, self._learners.dataset.time_count
        generator, count = self._draws.generator, len(self._scene)
        before, view = self._draws.mark(), self._draws.next()
        rates = learners.optimizer.rates_at(scheduled.step, scheduled.share)
        if learners.frequencies is not None:
            rates[FREQUENCIES] = rate_at(learners.frequencies.rate, scheduled.step)
        camera = self._draws.truth.camera(view.camera)
        task = Task(scheduled, before, view, camera, self._scene.timing(view.time), self._scene.sh_degree, rates)
        near = even = 0
        if config.field.kind != "static":
            near, even = compared_counts(config, scheduled, count, times, fitted=learners.field_fitted > 0)
        if near:
            task.near = Samples(near, count, _draw_seed(generator), config.smoothness.reach)
            task.near_time = near_time(config.smoothness, task.time, generator)
        if even:
            task.even = Samples(even, count, _draw_seed(generator))
            task.even_times = even_times(task.time, times, generator)
        return task

    def _submit(self, task: Task) -> Task:
        if "gaussians" in self.parameters.values_on_host:
            seen = torch.stack([*vars(self._density.statistics).values()], dim=1)
            self._passes.seen().write(seen.numpy(force=True))
        self.parameters.push()
        self._passes.corrections.push()
        truth, background = self._draws.truth.on_device(task.view), self._draws.truth.backgrounds[task.view]
        self._passes.check_driver(task)
        task.counts = dict(self.parameters.steps)
        with Commands(self._scene.device, whole=True) as commands:
            task.drawing, told = self._passes.record(commands, task, truth, background)
            task.later = Later(commands, told, self._ring)
        task.later.submitted()
        return task

    # A step's end ----------------------------------------------------------------------------------------------------

    def _finish_first_or_roll_back(self) -> None:
        """Wait for the step that was submitted first, and mend what it asks for.

        After an error the parameters are those after the step which `roll_back_to` is called with.
        """
        tasks = list(self._flying)
        try:
            self._finish_first()
        except Exception as error:
            self._flying.clear()
            undone = [task for task in tasks if task.measured is None]
            if undone:
                self._draws.go_back(undone[0].before)
                self._scene.sh_degree = undone[0].sh_degree
            bad = isinstance(error, NumericalError) and len(undone) == len(tasks)  # else too many steps were skipped
            self._roll_back_to(None if bad else tasks[-1].scheduled.step - len(undone))
            raise

    def _finish_first(self) -> None:
        first = self._flying[0]
        guard, bad, values, totals, *needed = first.later.read()
        terms = self._passes.terms(first, values.tolist(), totals.tolist())
        measured = Measured(sum(terms.values()), psnr_of(float(values[1])), terms=terms)
        if not guard[0]:  # all fitted, and all is finite
            self._passes.rasterizer.grow_on_overflow(first.drawing, needed)
            self._flying.popleft()
            first.measured = measured
            self._on_measured(measured)
            return
        behind = list(self._flying)  # which have changed nothing, as the first
        self._flying.clear()
        for each in behind[1:]:
            each.later.read()
        self._passes.guard.write(np.zeros(1, np.uint32))
        self.parameters.steps = dict(first.counts)
        if bad[0] & _OVERFLOW:  # the buffers were too small
            self._passes.rasterizer.grow_on_overflow(first.drawing, needed)
        else:  # something was not finite
            self.to_host()
            check_parameters(self._learners.parameters())
            skipped = Skipped(first.scheduled.step, first.view.name, cause(terms, {}))
            behind.pop(0)
            first.measured = measured._replace(skipped=skipped)
            self._on_measured(first.measured)
        self._flying.extend(self._submit(each) for each in behind)


def _draw_seed(generator: torch.Generator) -> int:
    return int(torch.randint(1 << 31, (), generator=generator))
