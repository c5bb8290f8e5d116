"""The passes of a step that stays on the device, from parameters to parameters, recorded once and replayed."""

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel, Later, Recording
from lapgs_wgpu.gpu.matmul import sum_columns
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.passes.activation_passes import ActivationPasses
from lapgs_wgpu.motion.passes.grid_field_passes import Decoding, FieldArrays, GridFieldPasses
from lapgs_wgpu.motion.passes.samples import NO_SAMPLES, Samples
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.drawing import Drawing, GaussianGradients
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.ground_truth import Mark
from lapgs_wgpu.train.image_loss import image_loss_of
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.resident_corrections import ResidentCorrections
from lapgs_wgpu.train.resident_parameters import ResidentParameters, check_finite
from lapgs_wgpu.train.step_result import Measured, Scheduled

TOTALS = ("static", "temporal", "acceleration", "dynamics")  # sums of losses of motion, in their places
_DYNAMICS_GROUPS, _MOST_COLUMNS = 64, 256  # common/dynamics.wgsl


@dataclass
class Task:
    """A resident step.

    scheduled: what the schedule says. before: where the draws stood before its view. view: of the training. camera: the
    view's, at the size that its image has. time: of the field. sh_degree: of the harmonics in use. rates: of the
    optimizer's groups, and of FREQUENCIES. near, near_time: the places and the time that the smoothness loss compares;
    none in steps without it. even, even_times: those of the acceleration loss. Once it was submitted: counts, how many
    steps had moved each tensor before; drawing; later, what it tells; once it is settled: measured.
    """

    scheduled: Scheduled
    before: Mark
    view: View
    camera: Camera
    time: float
    sh_degree: int
    rates: dict[str, float]
    near: Samples = NO_SAMPLES
    near_time: float = 0.0
    even: Samples = NO_SAMPLES
    even_times: tuple[float, float] = (0.0, 0.0)
    counts: dict[str, int] = field(init=False)
    drawing: Drawing = field(init=False)
    later: Later = field(init=False)
    measured: Measured | None = None


# The passes of a step: its drawing, and what is read of it later.
Recorded = tuple[Drawing, list[DeviceArray]]


class ResidentPasses:
    """Records the passes of the steps of a training.

    parameters, corrections: what the steps move, the latter of cameras and colors. guard: the word that names the step
    which may change nothing, nor those behind it; 0 where all is well.
    """

    def __init__(self, learners: Learners) -> None:
        config, scene = self._config, self._scene = learners.config, learners.scene
        self._device = scene.device
        self._field = GridFieldPasses(scene.device, scene.field_config) if isinstance(scene.field, GridField) else None
        self.parameters = ResidentParameters(learners, self._field)
        self.corrections = ResidentCorrections(learners)
        self._activation = ActivationPasses(scene.device, scene.field_config)
        self.rasterizer, self._losses = rasterizer_of(scene.device), image_loss_of(scene.device)
        self._pool = BufferPool(scene.device)
        self.guard, self._bad = (self._pool.array(name, (1,), "uint32") for name in ("guard", "bad"))
        self._totals = self._pool.array("totals", (len(TOTALS),))
        self._recordings: dict[tuple[Any, ...], Recording[Recorded]] = {}
        self._checked = False
        self._dynamics_loss = bool(config.loss.dynamics) and scene.field_config.dynamics_size > 0
        self._task: Task

    def terms(self, task: Task, values: list[float], totals: list[float]) -> dict[str, float]:
        """What each term adds to the loss of a step, by the losses of the image and of motion that `record` lists."""
        l1, _, *others = values
        weighted = zip(self._weights(task)._asdict().items(), (l1, *others), strict=True)
        found = {name: weight * value for (name, weight), value in weighted if weight or name == "l1"}
        static, temporal, even, dynamics = totals
        if task.near.count:
            found["smoothness"] = static + temporal
        if task.even.count:
            found["acceleration"] = even
        if task.scheduled.moving and self._dynamics_loss:
            found["dynamics"] = dynamics
        return found

    def _weights(self, task: Task) -> LossWeights:
        return self._config.loss.weights(warm=task.scheduled.moving)

    def seen(self) -> DeviceArray:
        """Density control's statistics, (N, 2)."""
        return self._pool.array("statistics", (len(self._scene), 2))

    def record(self, commands: Commands, task: Task, truth: DeviceArray, background: Tensor) -> Recorded:
        """Record a step. truth: (H, W), of its view. background: (3,) in [0, 1]."""
        red, green, blue = background.tolist()
        self._task, self._background = task, (red, green, blue)
        self.corrections.begin(task.view, task.scheduled.step)
        self.parameters.begin(task.rates, moving=task.scheduled.moving)
        held = self._losses.held(truth)
        commands.copy(truth, held)
        camera, plans = task.camera, self.rasterizer.plans
        plans.turn_to((camera.width, camera.height, True))
        # All that `_record` reads of the first step of a shape; the others replay what it recorded.
        kind = task.scheduled.moving, task.scheduled.seen, task.near.count > 0, task.even.count > 0, task.sh_degree
        shape = *kind, camera.width, camera.height, plans.now, len(self._scene), self.corrections.moves_camera
        if self._device.textures:  # copies to them depend on what was done before
            return self._record(commands, task, held)
        self._recordings = {key: each for key, each in self._recordings.items() if each.holds}
        if shape in self._recordings:
            recording = self._recordings[shape]
            recording.result[0].camera, recording.result[0].background = camera, self._background
            recording.replay(commands)
        else:
            recording = self._recordings[shape] = Recording(commands, lambda: self._record(commands, task, held))
        return recording.result

    def at(self, t: float, degree: int) -> Gaussians[DeviceArray]:
        """The Gaussians at a time of the field, in arrays that the next step overwrites. degree: of the harmonics."""
        with Commands(self._device) as commands:
            field, values = self._field, self.parameters.arrays("value")
            decoding = None if field is None else field.decode(commands, 0, values, lambda: t)
            return self._activate(commands, degree, decoding)

    def check_driver(self, task: Task) -> None:
        """Draw an image and its gradient once the ordinary way, which checks the driver's subgroups."""
        if self._checked:
            return
        self._checked = True
        camera = task.camera
        with Commands(self._device) as commands:
            drawn = self._activate(commands, task.sh_degree, None)
        d_image = self._losses.pool.array("d_image", (4, camera.height, camera.width))
        self.rasterizer.backward(self.rasterizer.draw_whole(drawn, camera, gradient=True), d_image)

    def _record(self, commands: Commands, first: Task, truth: DeviceArray) -> Recorded:
        """Record what is replayed in later steps of this shape: what differs between them is read from self._task, in
        functions that are called anew at each, never from `first`."""
        for array in (self._bad, self._totals):
            commands.clear(array)
        passes, field, corrections = self._activation, self._field, self.corrections
        smooth, even = self._config.smoothness, self._config.acceleration
        values, gradients = self.parameters.arrays("value"), self.parameters.arrays("gradient")
        decodings = self._decode(commands, first, values)
        now = decodings[0] if decodings else None
        drawn = self._activate(commands, first.sh_degree, now)
        drawing = self.rasterizer.record(commands, drawn, first.camera, self._background, corrections.move)
        image = corrections.expose(commands, drawing.image)
        terms, d_image = self._losses.record(commands, image, truth, self._weights(first))
        d_image = corrections.expose_bwd(commands, drawing.image, d_image)
        by_drawn = self.rasterizer.record_bwd(commands, drawing, d_image, camera=corrections.moves_camera)
        corrections.sum_camera(commands, by_drawn.camera)
        if first.even.count:
            scale = even.weight * even.interval / first.even.count
            accelerations = passes.acceleration(commands, decodings, scale, values, drawn, by_drawn, gradients)
            self._total(commands, accelerations, "acceleration", scale)
        passes.activate_bwd(commands, values, drawn, by_drawn, now, gradients)
        if field is not None and now is not None:
            for each in decodings:
                field.decode_bwd(commands, each, values, gradients)
            if first.near.count:
                weights = [weight / first.near.count for weight in (smooth.static, smooth.temporal)]
                times = now.time, lambda: self._task.near_time
                differences = field.compare(commands, values, gradients, lambda: self._task.near, times, weights)
                for name, sums, weight in zip(TOTALS, differences, weights, strict=False):
                    self._total(commands, sums, name, weight)
            if self._dynamics_loss:
                self._dynamics(commands, values.beside, gradients.beside)
        self._record_end(commands, first, drawing, by_drawn, terms)
        return drawing, [self.guard, self._bad, terms, self._totals, *drawing.needed]

    def _decode(self, commands: Commands, first: Task, values: FieldArrays) -> list[Decoding]:
        """Record the field at a step's time, and before and after it where the step has that."""
        field = self._field
        if field is None or not first.scheduled.moving:
            return []
        decodings = [field.decode(commands, 0, values, lambda: self._task.time)]
        if first.even.count:
            for number, time in ((3, lambda: self._task.even_times[0]), (4, lambda: self._task.even_times[1])):
                decodings.append(field.decode(commands, number, values, time, lambda: self._task.even))
        return decodings

    def _activate(self, commands: Commands, degree: int, decoding: Decoding | None) -> Gaussians[DeviceArray]:
        values, antialiased = self.parameters.arrays("value"), self._scene.antialiased
        return self._activation.activate(commands, values, degree, decoding, antialiased=antialiased)

    def _total(self, commands: Commands, values: DeviceArray, name: str, factor: float) -> None:
        """Record the sum of values, times a factor, in the place of this name."""
        sum_columns(commands, self._pool, values, self._totals, place=TOTALS.index(name), factor=factor)

    def _dynamics(self, commands: Commands, rows: DeviceArray, d_rows: DeviceArray) -> None:
        """Record the loss of the dynamics attributes and its gradient (motion/fields/dynamics)."""
        n, stride = rows.shape
        sums = ("distance_sums", "square_sums", "losses")
        arrays = {name: self._pool.array(f"dynamics {name}", (_DYNAMICS_GROUPS,)) for name in sums}
        arrays |= {"rows": rows, "d_rows": d_rows, "distances": self._pool.array("distances", (n,))}
        arrays["sums"] = self._pool.array("dynamics sums", (_DYNAMICS_GROUPS, _MOST_COLUMNS))
        sizes = {"gaussians": n, "columns": stride - 1, "stride": stride, "weight": self._config.loss.dynamics}
        for name in ("dynamics_mean", "dynamics_distances", "dynamics_deviation", "dynamics_bwd"):
            kernel = Kernel.get(self._device, name, GROUPS=_DYNAMICS_GROUPS)
            arrays["dynamics"] = self._pool.constant(kernel.uniform("Dynamics", **sizes))
            commands.run(kernel, _DYNAMICS_GROUPS, arrays)
        self._total(commands, arrays["losses"], "dynamics", 1.0)

    def _record_end(
        self, commands: Commands, first: Task, drawing: Drawing, by_drawn: GaussianGradients, terms: DeviceArray
    ) -> None:
        """Record whether the step may change anything, and what it changes."""
        count, guard = len(self._scene), self.guard
        for values in (*self.parameters.gradients(), *self.corrections.gradients(), terms):
            check_finite(commands, self._pool, values, self._bad)
        close = Kernel.get(self._device, "close_guard")
        given = {"capacity": drawing.plan.capacity, "rounds": int(bool(self.rasterizer.config.round_splats))}
        guarded = self._pool.varying(
            "guarded", lambda: close.uniform("Guarded", step=self._task.scheduled.step, **given)
        )
        for needed in drawing.needed:
            commands.dispatch(close, 1, guarded=guarded, needed=needed, bad=self._bad, guard=guard)
        if first.scheduled.seen:
            kernel, camera = Kernel.get(self._device, "accumulate_statistics"), first.camera
            content = kernel.uniform("Seen", half_size=(camera.width / 2, camera.height / 2), gaussians=count)
            arrays = {"splats": drawing.splats, "d_splats": by_drawn.splats, "statistics": self.seen()}
            seen = self._pool.constant(content)
            commands.dispatch(kernel, -(-count // 64), seen=seen, guard=guard, **arrays)
        self.parameters.record_adam(commands, guard)
        geometry = self.parameters.blocks["geometry"].arrays["value"]
        self.corrections.record_step(commands, guard, drawing.arrays["frame"], geometry)
