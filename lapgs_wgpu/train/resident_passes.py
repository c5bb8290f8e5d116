"""The passes of a step that stays on the device, from parameters to parameters, recorded once and replayed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.gpu.recording import Recording
from lapgs_wgpu.gpu.sums import sum_columns
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.passes.activation_passes import ActivationPasses, Line
from lapgs_wgpu.motion.passes.grid_field_passes import Comparison, Decoding, FieldArrays, GridFieldPasses
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.drawing import Drawing, GaussianGradients
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.config import Config, LossWeights
from lapgs_wgpu.train.fused_loss import image_loss_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.resident_corrections import ResidentCorrections
from lapgs_wgpu.train.resident_parameters import ResidentParameters, check_finite
from lapgs_wgpu.train.resident_task import Task

TOTALS = ("static", "temporal", "acceleration", "dynamics")  # sums of losses of motion, in their places
_DYNAMICS_GROUPS, _MOST_COLUMNS = 64, 256  # common/dynamics.wgsl


class Recorded(NamedTuple):
    """The passes of a step. told: what is read of it later."""

    recording: Recording | None
    drawing: Drawing
    told: list[DeviceArray]

    def holds(self, device: Device) -> bool:
        """Whether it can be replayed."""
        return self.recording is not None and self.recording.generation == device.generation


class ResidentPasses:
    """Records the passes of the steps of a training.

    Attributes:
        parameters: what the steps move. corrections: of cameras and colors, which they move, too.
        rasterizer: that draws.
        dynamics_loss: whether the loss has a term of the dynamics attributes.
    """

    def __init__(self, config: Config, scene: Scene4D, learners: Learners) -> None:
        self._config, self._scene, self._device = config, scene, scene.device
        field = scene.field if isinstance(scene.field, GridField) else None
        self._field = GridFieldPasses(scene.device, scene.field_config) if field else None
        weights = self._field.weights if self._field else None
        self.parameters = ResidentParameters(
            scene.device, scene.parameters, field, weights, learners.optimizer, learners.frequencies
        )
        self.corrections = ResidentCorrections(scene.device, learners)
        self._activation = ActivationPasses(scene.device, scene.field_config)
        self.rasterizer, self._losses = rasterizer_of(scene.device), image_loss_of(scene.device)
        self._pool = BufferPool(scene.device)
        self._recordings: dict[tuple[Any, ...], Recorded] = {}
        self._checked = False
        self.dynamics_loss = bool(config.loss.dynamics) and scene.field_config.dynamics_size > 0
        self._task: Task

    @property
    def moves(self) -> bool:
        """Whether there is a field."""
        return self._field is not None

    def weights(self, task: Task) -> LossWeights:
        """Of the image losses of a step."""
        return self._config.loss.weights(warm=task.scheduled.moving)

    def seen(self) -> DeviceArray:
        """Density control's statistics, (N, 2)."""
        return self._pool.array("statistics", (len(self._scene), 2))

    def word(self, name: str) -> DeviceArray:
        """A word that passes share: guard, bad or dead."""
        return self._pool.array(name, (1,), "uint32")

    def record(self, commands: Commands, task: Task, truth: DeviceArray, *, judged: bool) -> Recorded:
        """Record a step. truth: (H, W), of its view. judged: only up to the gradients, which stay."""
        self._task = task
        self.corrections.begin(task.sample.view, task.scheduled.step)
        self.parameters.count_step(moving=task.scheduled.moving)
        self.parameters.write_rates(task.rates, moving=task.scheduled.moving)
        held = self._losses.held(truth)
        commands.copy(truth, held)
        return self._recorded(commands, task, held, judged=judged)

    def at(self, t: float, degree: int) -> Gaussians[DeviceArray]:
        """The Gaussians at a time of the field, in arrays that the next step overwrites. degree: of the harmonics."""
        values, decoding, dead = self.parameters.arrays("value"), None, self.word("dead")
        with Commands(self._device) as commands:
            commands.clear(dead)
            if self._field is not None:
                self._field.begin(commands, values)
                decoding = self._field.decode(commands, 0, values, lambda: t)
            return self._activate(commands, degree, decoding, dead)

    def check_driver(self, task: Task) -> None:
        """Draw an image and its gradient once the ordinary way, which checks the driver's subgroups."""
        if self._checked:
            return
        self._checked = True
        view = task.sample.view
        with Commands(self._device) as commands:
            commands.clear(self.word("dead"))
            drawn = self._activate(commands, task.sh_degree, None, self.word("dead"))
        d_image = self._losses.pool.array("d_image", (4, view.camera.height, view.camera.width))
        while True:
            drawing = self.rasterizer.draw(drawn, view.camera, gradient=True)
            if not self.rasterizer.grow_on_overflow(drawing):
                break
        self.rasterizer.backward(drawing, d_image)

    def _recorded(self, commands: Commands, task: Task, truth: DeviceArray, *, judged: bool) -> Recorded:
        """Record a step's passes, or replay those of one of the same shape."""
        camera, plan = task.sample.view.camera, self.rasterizer.plan_of(task.sample.view.camera)
        shape = (
            *(task.scheduled.moving, task.scheduled.seen, task.sample.near is None, task.sample.even is None),
            *(task.sh_degree, task.sample.background, camera.width, camera.height, plan, judged, len(self._scene)),
            self.corrections.moves_camera,
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
    ) -> Recorded:
        sample = task.sample
        values, gradients = self.parameters.arrays("value"), self.parameters.arrays("gradient")
        guard, bad, dead = (self.word(name) for name in ("guard", "bad", "dead"))
        totals = self._pool.array("totals", (len(TOTALS),))
        for array in (bad, dead, totals):
            commands.clear(array)
        decoding, comparison, line = self._decode(commands, task, values)
        drawn = self._activate(commands, task.sh_degree, decoding, dead)
        corrections = self.corrections
        drawing = self.rasterizer.record(commands, drawn, sample.view.camera, sample.background, corrections.move)
        image = corrections.expose(commands, drawing.image)
        terms, d_image = self._losses.record(commands, image, truth, sample.background, self.weights(task))
        d_image = corrections.expose_bwd(commands, drawing.image, d_image)
        by_drawn = self.rasterizer.record_bwd(commands, drawing, d_image, camera=corrections.moves_camera)
        corrections.sum_camera(commands, by_drawn.camera)
        self._activate_bwd(commands, drawn, by_drawn, decoding, line, totals)
        if self._field is not None and decoding is not None:
            self._decode_bwd(commands, values, gradients, decoding, comparison, line, totals)
        self._record_end(commands, task, drawing, by_drawn, terms, judged=judged)
        return Recorded(recording, drawing, [guard, bad, dead, terms, totals, *drawing.needed])

    def _decode(
        self, commands: Commands, task: Task, values: FieldArrays
    ) -> tuple[Decoding | None, Comparison | None, Line | None]:
        sample, field = task.sample, self._field
        if field is None or not task.scheduled.moving:
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
        self, commands: Commands, degree: int, decoding: Decoding | None, dead: DeviceArray
    ) -> Gaussians[DeviceArray]:
        blocks = self.parameters.blocks
        return self._activation.activate(
            commands,
            blocks["geometry"].arrays["value"],
            blocks["sh"].arrays["value"],
            degree,
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
            for total, sums, weight in zip(TOTALS, comparison.sums, weights, strict=False):
                self._total(commands, sums, total, weight, totals)
            field.compare_bwd(commands, comparison, gradients, weights)
        field.end(commands, gradients)
        if self.dynamics_loss:
            self._dynamics(commands, values.beside, gradients.beside, totals)

    def _total(self, commands: Commands, values: DeviceArray, name: str, factor: float, totals: DeviceArray) -> None:
        """Record the sum of values, times a factor, in the place of this name."""
        sum_columns(commands, self._pool, name, values, totals, place=TOTALS.index(name), factor=factor)

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
        device, moving = self._device, task.scheduled.moving
        guard, bad = self.word("guard"), self.word("bad")
        self.parameters.record_check(commands, bad, moving=moving)
        self.corrections.record_check(commands, bad)
        check_finite(commands, self._pool, "terms", terms, bad)
        close = Kernel.get(device, "close_guard")
        plan = drawing.plan
        rounds = int(bool(self.rasterizer.config.round_splats))

        def guarded_step() -> DeviceArray:
            content = close.uniform("Guarded", step=self._task.scheduled.step, capacity=plan.capacity, rounds=rounds)
            return self._pool.constant("guarded", content)

        guarded = commands.varying(guarded_step)
        for needed in drawing.needed:
            commands.dispatch(close, 1, guarded=guarded, needed=needed, bad=bad, guard=guard)
        if judged:
            return
        if task.scheduled.seen:
            kernel, camera = Kernel.get(device, "accumulate_statistics"), task.sample.view.camera
            content = kernel.uniform(
                "Seen", half_size=(camera.width / 2, camera.height / 2), gaussians=len(self._scene)
            )
            commands.dispatch(
                kernel,
                -(-len(self._scene) // 64),
                seen=self._pool.constant("seen", content),
                guard=guard,
                splats=drawing.splats,
                d_splats=by_drawn.splats,
                statistics=self.seen(),
            )
        self.parameters.record_adam(commands, guard, lambda: self._task.frequency_rate, moving=moving)
        geometry = self.parameters.blocks["geometry"].arrays["value"]
        self.corrections.record_step(commands, guard, drawing.frames[0], geometry)
