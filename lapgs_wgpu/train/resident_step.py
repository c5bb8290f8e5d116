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
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.later import Later, Ring
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.gpu.recording import Recording
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.passes.activation_passes import ActivationPasses, Line
from lapgs_wgpu.motion.passes.grid_field_passes import Comparison, Decoding, FieldArrays, GridFieldPasses
from lapgs_wgpu.motion.passes.samples import Samples
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.drawing import Drawing, GaussianGradients
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.acceleration import LARGEST_DISTANCE
from lapgs_wgpu.train.config import Config, LossWeights
from lapgs_wgpu.train.densify import Statistics
from lapgs_wgpu.train.fused_loss import image_loss_of
from lapgs_wgpu.train.ground_truth import GroundTruth
from lapgs_wgpu.train.image_loss import TERMS
from lapgs_wgpu.train.image_metrics import psnr_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.nonfinite import Skipped, cause, check_parameters
from lapgs_wgpu.train.resident_parameters import ResidentParameters
from lapgs_wgpu.train.step_result import Measured

IN_FLIGHT = 2  # steps that are submitted and not waited for
_TOTALS = ("static", "temporal", "acceleration", "dynamics")  # sums of losses of motion, in their places
_DYNAMICS_GROUPS, _MOST_COLUMNS = 64, 256  # common/dynamics.wgsl
_RING_BYTES = 8192
_OVERFLOW = 1 << 31  # close_guard.wgsl
_TERM_BIT = 1 << 30


@dataclass(frozen=True)
class ResidentSample:
    """What a step looks at.

    view: of the training, on a background (3,). moving: whether the field moves the Gaussians. near, near_time: the
    places and the time that the smoothness loss compares; None in steps without it. even, even_times: those of the
    acceleration loss.
    """

    view: View
    background: tuple[float, float, float]
    moving: bool
    near: Samples | None = None
    near_time: float = 0.0
    even: Samples | None = None
    even_times: tuple[float, float] = (0.0, 0.0)


@dataclass
class Task:
    """A step to be taken.

    step: counted from 1. sample: drawn for it. time: of the field. sh_degree: of the harmonics in use. rates: of the
    optimizer's groups, and of the frequencies. seen: whether density control takes the view in. counts: how many steps
    had moved each tensor before.
    """

    step: int
    sample: ResidentSample
    time: float
    sh_degree: int
    rates: dict[str, float]
    frequency_rate: float
    seen: bool
    counts: dict[str, int] = dataclasses.field(default_factory=dict)


class _Flying(NamedTuple):
    """A step that was submitted."""

    task: Task
    drawing: Drawing
    later: Later
    result: Pending


class _Recorded(NamedTuple):
    """The passes of a step. told: what is read of it later."""

    recording: Recording | None
    drawing: Drawing
    told: list[DeviceArray]

    def holds(self, device: Device) -> bool:
        """Whether it can be replayed."""
        return self.recording is not None and self.recording.generation == device.generation


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

    redraw: called after a step that was skipped, with the steps behind it that were in flight; gives their tasks anew.
    tell: called with what each step tells, in their order.
    """

    def __init__(
        self,
        config: Config,
        scene: Scene4D,
        learners: Learners,
        truth: GroundTruth,
        time_count: int,
    ) -> None:
        self._config, self._scene, self._truth = config, scene, truth
        self._time_count = time_count
        self._device = device = scene.device
        self._field = GridFieldPasses(device, scene.field_config) if isinstance(scene.field, GridField) else None
        weights = self._field.weights if self._field else None
        field = scene.field if isinstance(scene.field, GridField) else None
        self._learners = learners
        frequencies = learners.frequencies
        self.parameters = ResidentParameters(device, scene.parameters, field, weights, learners.optimizer, frequencies)
        self._activation = ActivationPasses(device, scene.field_config)
        self._rasterizer, self._losses = rasterizer_of(device), image_loss_of(device)
        self._pool = BufferPool(device)
        self._ring = Ring(device, _RING_BYTES)
        self._flying: deque[_Flying] = deque()
        self._recordings: dict[tuple[Any, ...], _Recorded] = {}
        self._checked = False
        self._statistics_on_host = True
        self.statistics: Statistics | None = None
        self.field_fitted = False
        self.redraw: Callable[[int, list[int]], list[Task]] = lambda step, behind: []
        self.tell: Callable[[Measured], None] = lambda measured: None
        self.dead_scales = 0.0
        scene.on_access = self.to_host
        learners.optimizer.on_access = self.to_rest

    # Between steps ---------------------------------------------------------------------------------------------------

    def to_host(self) -> None:
        """Wait for all steps, and make the scene's tensors the newest ones."""
        self.settle()
        self.parameters.pull_values()
        if not self._statistics_on_host and self.statistics is not None:
            self._statistics_on_host = True
            seen = torch.from_numpy(self._seen().read())
            for target, column in zip(vars(self.statistics).values(), seen.T, strict=False):
                target.copy_(column)

    def to_rest(self) -> None:
        """The same with the optimizers' state."""
        self.to_host()
        self.parameters.pull_state()

    @torch.no_grad()
    def spectrum(self) -> dict[str, Tensor]:
        """The motion's frequencies and amplitudes after all steps, without the rest of the parameters."""
        if self._field is None or self._learners.frequencies is None:
            return {}
        self.settle()
        return self.parameters.spectrum()

    def settle(self) -> None:
        """Wait for all steps."""
        while self._flying:
            self._settle_first()

    def make_room(self) -> None:
        """Wait until one more step may be in flight. Nothing may have been drawn for it yet."""
        while len(self._flying) >= IN_FLIGHT:
            self._settle_first()

    def draw(
        self, view: View, background: Tensor, step: int, generator: torch.Generator, *, moving: bool
    ) -> ResidentSample:
        """Draw what a step, counted from 1, looks at."""
        config, count, t = self._config, self.count, self._scene.timing(view.time)
        red, green, blue = background.tolist()
        sample = ResidentSample(view, (red, green, blue), moving)
        if not moving or self._field is None or step <= config.smoothness.start:
            return sample
        smooth, even = config.smoothness, config.acceleration
        near = round(smooth.share * count)
        if near and (smooth.static or smooth.temporal):
            chosen = Samples(near, count, *_draw_rows(count, generator), smooth.reach)
            shift = smooth.time_reach * (2 * float(torch.rand((), generator=generator)) - 1)
            sample = dataclasses.replace(sample, near=chosen, near_time=min(max(t + shift, 0.0), 1.0))
        chosen = round(even.share * count)
        left_out = self.field_fitted or step % even.interval or not even.weight or self._time_count < 3
        if chosen and not left_out:
            samples = Samples(chosen, count, *_draw_rows(count, generator))
            reach = LARGEST_DISTANCE / (self._time_count - 1) * (1 + float(torch.rand((), generator=generator))) / 2
            sample = dataclasses.replace(sample, even=samples, even_times=(max(t - reach, 0.0), min(t + reach, 1.0)))
        return sample

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self._scene)

    def take(self, task: Task) -> Pending:
        """Submit a step, after `make_room`; what it will have told."""
        self._push()
        flying = self._submit(task, Pending(self._settle_first))
        self._flying.append(flying)
        return flying.result

    def _push(self) -> None:
        self.parameters.push()
        if self._statistics_on_host and self.statistics is not None:
            self._statistics_on_host = False
            columns = [*(values.numpy(force=True) for values in vars(self.statistics).values()), np.zeros(self.count)]
            self._seen().write(np.stack(columns, axis=1).astype(np.float32))

    def _seen(self) -> DeviceArray:
        return self._pool.array("statistics", (self.count, 4))

    def _word(self, name: str) -> DeviceArray:
        return self._pool.array(name, (1,), "uint32")

    # A step's end ----------------------------------------------------------------------------------------------------

    def _settle_first(self) -> None:
        """Wait for the step that was submitted first, and mend what it asks for."""
        flying = self._flying[0]
        words, terms, totals, needed = self._told(flying)
        if not words["guard"]:
            self._rasterizer.grow_on_overflow(flying.drawing, needed)
            self._flying.popleft()
            self.dead_scales = int(words["dead"]) / max(1, 3 * self.count)
            flying.result.value = self._measured(flying.task, terms, totals, None)
            self.tell(flying.result.value)
            return
        behind = self._ground()
        if words["bad"] & _OVERFLOW:
            self._rasterizer.grow_on_overflow(flying.drawing, needed)
            self._again([(each.task, each.result) for each in behind])
            return
        # Not finite. The gradients are gone that were: this step alone once more, behind the closed guard.
        self._word("guard").write(np.array([flying.task.step], np.uint32))
        self._told(self._submit(flying.task, flying.result, judged=True))
        gradients = self.parameters.gradients()
        with Commands(self._device) as commands:
            self.parameters.clear_gradients(commands)
        self.parameters.steps = dict(flying.task.counts)
        self.parameters.pull_values()
        check_parameters(self._learners.parameters())
        self._word("guard").write(np.zeros(1, np.uint32))
        values = self._terms(flying.task, terms, totals)
        what = cause([values], gradients)
        skipped = Skipped(flying.task.step, flying.task.sample.view.name, what)
        flying.result.value = self._measured(flying.task, terms, totals, skipped)
        tasks = self.redraw(flying.task.step, [each.task.step for each in behind[1:]])
        self.tell(flying.result.value)
        self.parameters.push()
        self._again(list(zip(tasks, [each.result for each in behind[1:]], strict=True)))

    def _ground(self) -> list[_Flying]:
        """All steps in flight, which have changed nothing; none is in flight any more, and the guard is open."""
        behind = list(self._flying)
        self._flying.clear()
        for each in behind[1:]:
            each.later.read()
        self._word("guard").write(np.zeros(1, np.uint32))
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

    def _weights(self, task: Task) -> LossWeights:
        return self._config.loss.weights(warm=task.sample.moving)

    def _terms(self, task: Task, terms: NDArray[np.float32], totals: NDArray[np.float32]) -> dict[str, float]:
        weights, values = self._weights(task), terms.tolist()
        found = {"l1": weights.l1 * values[0]}
        for name, value in zip(("ssim", "pyramid", "ncc"), values[2:], strict=True):
            if weight := getattr(weights, name):
                found[name] = weight * value
        static, temporal, even, dynamics = totals.tolist()
        if task.sample.near is not None:
            found["smoothness"] = static + temporal
        if task.sample.even is not None:
            found["acceleration"] = even
        if task.sample.moving and self._has_dynamics_loss:
            found["dynamics"] = dynamics
        return found

    def _measured(
        self, task: Task, terms: NDArray[np.float32], totals: NDArray[np.float32], skipped: Skipped | None
    ) -> Measured:
        found = self._terms(task, terms, totals)
        mse = float(terms[1])
        psnr = psnr_of(mse) if math.isfinite(mse) else math.nan
        return Measured(math.fsum(found.values()) if skipped is None else sum(found.values()), psnr, skipped, found)

    @property
    def _has_dynamics_loss(self) -> bool:
        return bool(self._config.loss.dynamics) and self._scene.field_config.dynamics_size > 0

    # The passes of a step --------------------------------------------------------------------------------------------

    def _submit(self, task: Task, result: Pending, *, judged: bool = False) -> _Flying:
        """Submit a step. judged: only up to its gradients, which stay."""
        self._task = task
        truth = self._truth.on_device(task.sample.view)
        self._check_driver(task)
        task.counts = dict(self.parameters.steps)
        self.parameters.count_step(moving=task.sample.moving)
        self.parameters.write_rates(task.rates, moving=task.sample.moving)
        held = self._losses.held(truth)
        with Commands(self._device, whole=True) as commands:
            commands.copy(truth, held)
            step = self._recorded(commands, task, held, judged=judged)
            later = self._ring.record(commands, step.told)
        later.submitted()
        return _Flying(task, step.drawing, later, result)

    def _recorded(self, commands: Commands, task: Task, truth: DeviceArray, *, judged: bool) -> _Recorded:
        """Record a step's passes, or replay those of one of the same shape."""
        camera, plan = task.sample.view.camera, self._rasterizer.plan_of(task.sample.view.camera)
        shape = (
            *(task.sample.moving, task.sample.near is None, task.sample.even is None, task.sh_degree, task.seen),
            *(task.sample.background, camera.width, camera.height, plan, judged, self.count),
        )
        found = self._recordings.get(shape)
        if found is not None and found.recording is not None and found.holds(self._device):
            found.drawing.camera = camera
            commands.replay(found.recording)
            return found
        # Textures follow their buffers by copies that no recording has.
        recording = None if self._device.textures else Recording(self._device.generation)
        with commands.taken_down(recording):
            step = self._record(commands, task, truth, recording, judged=judged)
        if recording is not None:
            recording.generation = self._device.generation
            of_today = {key: each for key, each in self._recordings.items() if each.holds(self._device)}
            self._recordings = of_today | {shape: step}
        return step

    def _record(
        self, commands: Commands, task: Task, truth: DeviceArray, recording: Recording | None, *, judged: bool
    ) -> _Recorded:
        sample = task.sample
        values, gradients = self.parameters.arrays("value"), self.parameters.arrays("gradient")
        guard, bad, dead = (self._word(name) for name in ("guard", "bad", "dead"))
        totals = self._pool.array("totals", (len(_TOTALS),))
        for array in (bad, dead, totals):
            commands.clear(array)
        decoding, comparison, line = self._decode(commands, task, values)
        drawn = self._activate(commands, task, decoding, dead)
        drawing = self._rasterizer.record(commands, drawn, sample.view.camera, sample.background)
        terms, d_image = self._losses.record(
            commands, drawing.image, truth, sample.background, self._weights(task), gradient=True
        )
        assert d_image is not None
        by_drawn = self._rasterizer.record_bwd(commands, drawing, d_image)
        self._activate_bwd(commands, drawn, by_drawn, decoding, line, totals)
        if self._field is not None and decoding is not None:
            self._decode_bwd(commands, values, gradients, decoding, comparison, line, totals)
        self._record_end(commands, task, drawing, by_drawn, terms, judged=judged)
        return _Recorded(recording, drawing, [guard, bad, dead, terms, totals, *drawing.needed])

    def _check_driver(self, task: Task) -> None:
        """Draw an image and its gradient once the ordinary way, which checks the driver's subgroups."""
        if self._checked:
            return
        self._checked = True
        view = task.sample.view
        with Commands(self._device) as commands:
            commands.clear(self._word("dead"))
            drawn = self._activate(commands, task, None, self._word("dead"))
        d_image = self._losses.pool.array("d_image", (4, view.camera.height, view.camera.width))
        while True:
            drawing = self._rasterizer.draw(drawn, view.camera, gradient=True)
            if not self._rasterizer.grow_on_overflow(drawing):
                break
        self._rasterizer.backward(drawing, d_image)

    def _decode(
        self, commands: Commands, task: Task, values: FieldArrays
    ) -> tuple[Decoding | None, Comparison | None, Line | None]:
        sample, field = task.sample, self._field
        if field is None or not sample.moving:
            return None, None, None
        field.begin(commands, values)
        decoding, comparison, line = field.decode(commands, 0, values, self._time), None, None
        if sample.near is not None:
            near_time = self._of_sample("near_time")
            comparison = field.compare(commands, 1, values, self._time, self._of_sample("near"), near_time)
        if sample.even is not None:
            even, config = self._of_sample("even"), self._config.acceleration
            before = field.decode(commands, 3, values, lambda: self._task.sample.even_times[0], even)
            after = field.decode(commands, 4, values, lambda: self._task.sample.even_times[1], even)
            scale = config.weight * config.interval / sample.even.count
            line = Line(even, before, after, self._even_share, scale)
        return decoding, comparison, line

    # What varies from step to step: recorded passes ask for it anew.

    def _time(self) -> float:
        return self._task.time

    def _of_sample(self, name: str) -> Callable[[], Any]:
        return lambda: getattr(self._task.sample, name)

    def _even_share(self) -> float:
        before, after = self._task.sample.even_times
        return (self._task.time - before) / (after - before)

    def _activate(
        self, commands: Commands, task: Task, decoding: Decoding | None, dead: DeviceArray
    ) -> Gaussians[DeviceArray]:
        blocks = self.parameters.blocks
        return self._activation.activate(
            commands,
            blocks["geometry"].arrays["value"],
            blocks["sh"].arrays["value"],
            task.sh_degree,
            decoding,
            dead,
            antialiased=self._scene.antialiased,
        )

    def _activate_bwd(
        self,
        commands: Commands,
        drawn: Gaussians[DeviceArray],
        by_drawn: GaussianGradients,
        decoding: Decoding | None,
        line: Line | None,
        totals: DeviceArray,
    ) -> None:
        blocks, passes = self.parameters.blocks, self._activation
        geometry, d_geometry = (blocks["geometry"].arrays[kind] for kind in ("value", "gradient"))
        if line is not None:
            accelerations = passes.acceleration(commands, line, geometry, drawn)
            self._total(commands, accelerations, "acceleration", line.scale, totals)
            passes.acceleration_bwd(commands, line, geometry, drawn, by_drawn, d_geometry)
        passes.activate_bwd(commands, geometry, drawn, by_drawn, decoding, d_geometry, blocks["sh"].arrays["gradient"])

    def _decode_bwd(
        self,
        commands: Commands,
        values: FieldArrays,
        gradients: FieldArrays,
        decoding: Decoding,
        comparison: Comparison | None,
        line: Line | None,
        totals: DeviceArray,
    ) -> None:
        field, smooth = self._field, self._config.smoothness
        assert field is not None
        field.decode_bwd(commands, decoding, values, gradients, first=True)
        for each in () if line is None else (line.before, line.after):
            field.decode_bwd(commands, each, values, gradients, first=False)
        if comparison is not None:
            weights = [weight / comparison.points[0].count for weight in (smooth.static, smooth.temporal)]
            for total, sums, weight in zip(_TOTALS, comparison.sums, weights, strict=False):
                self._total(commands, sums, total, weight, totals)
            field.compare_bwd(commands, comparison, gradients, weights)
        field.end(commands, gradients)
        if self._has_dynamics_loss:
            self._dynamics(commands, values.beside, gradients.beside, totals)

    def _total(self, commands: Commands, values: DeviceArray, name: str, factor: float, totals: DeviceArray) -> None:
        """Record the sum of values, times a factor, in the place of this name."""
        kernel = Kernel.get(self._device, "sum_values")
        content = kernel.uniform("Values", count=values.size, place=_TOTALS.index(name), factor=factor)
        uniform = self._pool.constant(f"total {name}", content)
        commands.dispatch(kernel, 1, sum=uniform, values=values, totals=totals)

    def _dynamics(self, commands: Commands, rows: DeviceArray, d_rows: DeviceArray, totals: DeviceArray) -> None:
        """Record the loss of the dynamics attributes and its gradient (motion/fields/dynamics)."""
        n, stride = rows.shape
        arrays = {
            "rows": rows,
            "d_rows": d_rows,
            "sums": self._pool.array("dynamics sums", (_DYNAMICS_GROUPS, _MOST_COLUMNS)),
            "distances": self._pool.array("distances", (n,)),
            **{
                name: self._pool.array(f"dynamics {name}", (_DYNAMICS_GROUPS,))
                for name in ("distance_sums", "square_sums", "losses")
            },
        }
        weight = self._config.loss.dynamics
        for name in ("dynamics_mean", "dynamics_distances", "dynamics_deviation", "dynamics_bwd"):
            kernel = Kernel.get(self._device, name, GROUPS=_DYNAMICS_GROUPS)
            content = kernel.uniform("Dynamics", gaussians=n, columns=stride - 1, stride=stride, weight=weight)
            arrays["dynamics"] = self._pool.constant("dynamics", content)
            commands.run(kernel, _DYNAMICS_GROUPS, arrays)
        self._total(commands, arrays["losses"], "dynamics", 1.0, totals)

    def _record_end(
        self,
        commands: Commands,
        task: Task,
        drawing: Drawing,
        by_drawn: GaussianGradients,
        terms: DeviceArray,
        *,
        judged: bool,
    ) -> None:
        device, moving = self._device, task.sample.moving
        guard, bad = self._word("guard"), self._word("bad")
        self.parameters.record_check(commands, bad, moving=moving)
        check = Kernel.get(device, "check_finite")
        content = check.uniform("Check", count=TERMS, bit=_TERM_BIT)
        commands.dispatch(check, 1, check=self._pool.constant("check terms", content), values=terms, bad=bad)
        close = Kernel.get(device, "close_guard")
        plan = drawing.plan
        rounds = int(bool(self._rasterizer.config.round_splats))

        def guarded_step() -> DeviceArray:
            content = close.uniform("Guarded", step=self._task.step, capacity=plan.capacity, rounds=rounds)
            return self._pool.constant("guarded", content)

        guarded = commands.varying(guarded_step)
        for needed in drawing.needed:
            commands.dispatch(close, 1, guarded=guarded, needed=needed, bad=bad, guard=guard)
        if judged:
            return
        if task.seen:
            kernel, camera = Kernel.get(device, "accumulate_statistics"), task.sample.view.camera
            content = kernel.uniform("Seen", half_size=(camera.width / 2, camera.height / 2), gaussians=self.count)
            commands.dispatch(
                kernel,
                -(-self.count // 64),
                seen=self._pool.constant("seen", content),
                guard=guard,
                splats=drawing.splats,
                d_splats=by_drawn.splats,
                statistics=self._seen(),
            )
        self.parameters.record_adam(commands, guard, lambda: self._task.frequency_rate, moving=moving)


def _draw_rows(count: int, generator: torch.Generator) -> tuple[int, int]:
    """First row and seed of samples."""
    first, seed = torch.randint(1 << 31, (2,), generator=generator).tolist()
    return first % count, seed
