"""The training, step by step, and everything that its next step depends on."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import NumericalError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView, captured_arc
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import Timing
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.camera_refinement import CameraRefinement
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.densify import Statistics
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.evaluate import evaluate
from lapgs_wgpu.train.exchange_step import ExchangeStep
from lapgs_wgpu.train.ground_truth import Draws, GroundTruth, backgrounds_of
from lapgs_wgpu.train.host import step_threads, torch_threads
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.resident_step import IN_FLIGHT, ResidentStep
from lapgs_wgpu.train.setup import Start, set_up, start_from_points, why_exchange
from lapgs_wgpu.train.step_result import Measured, Scheduled, StepResult
from lapgs_wgpu.train.timing_refinement import TimingRefinement

MAX_SH_DEGREE = 3
MOST_SKIPPED = 10  # steps in a row, which end a training


class Trainer:
    """A training, step by step.

    A context manager, and an iterator of the steps that are left.

    Attributes:
        scene: as the last step left it.
        config: the configuration, resolved for the data and the device.
        user_config: the same before it was resolved for the data, but for the place of the steps; config.toml holds it.
        dataset: its test views are not touched by any step.
        parts: own field, losses, density control, learning rates and callbacks.
        done: number of the steps so far.
        warm_up_steps: number of the first steps without motion.
        callbacks: a list of functions of the trainer and the StepResult, called after each step.
        discovery: what motion discovery found, a sentence; None where it was left out.
        discovery_seconds: that it took; 0 where it was left out.
        timing: the corrections of the training images' times; None where they are kept.
        whole: False while a step is partly applied, and after an error in that part of it.
    """

    def __init__(
        self,
        config: Config,
        dataset: Dataset | None = None,
        device: Device | None = None,
        *,
        scene: Scene4D | None = None,
        start: Start | None = None,
        parts: Parts | None = None,
    ) -> None:
        """Open the data and prepare the first step. No motion discovery is done here (`start_training` does it first).

        Without a scene and a start, the training starts from initial points, or from what `restore` is given.

        Args:
            config: as `load_config` gives it.
            dataset: None for the one that config.data names; a built-in scene is then written into the folder runs.
            device: None for the default adapter.
            scene: to start from, and to move from the first step on. Its field keeps its shape, whatever config.field
                says.
            start: what motion discovery found.
            parts: own field, losses, density control, learning rates and callbacks.

        Raises:
            InputError: the configuration, the data, the scene and the parts do not fit each other.
        """
        self.parts = parts or Parts()
        self.user_config, config, dataset, device = set_up(config, dataset, device, self.parts, scene)
        if scene is not None:
            start = Start(scene, ramp_steps=config.schedule.warm_up)
        elif start is None:
            start = start_from_points(config, dataset, device, self.parts.field)
        scene = start.scene
        self.config, self.dataset, self.scene = config, dataset, scene
        self.discovery, self.discovery_seconds = start.summary, start.seconds
        self.warm_up_steps, self._ramp_steps = start.warm_up_steps, start.ramp_steps
        self.callbacks = list(self.parts.callbacks)
        self.done = 0
        generator = torch.Generator().manual_seed(config.seed)
        backgrounds = backgrounds_of(dataset.train, config.data)
        self._truth = GroundTruth(scene.device, backgrounds, int(config.data.cache_gb * 1e9))
        self._draws = Draws(dataset.train, generator, self._truth)
        self._learners = Learners(config, dataset, self.parts, start)
        self._density = DensityControl(self._learners, generator)
        self.timing = None
        if config.timing.refine and scene.field is not None and len(dataset.times) > 2:
            self.timing = TimingRefinement(scene, dataset.train, self._truth.on_host, self._picture, dataset.time_gap)
        self._skipped = 0  # steps in a row
        shared = self._learners, self._density, self._draws
        self._exchange = ExchangeStep(*shared)
        self._resident = None
        if config.step_place == "resident":
            self._resident = ResidentStep(*shared, self._roll_back_to, self._count_skipped)
        self._plans = rasterizer_of(scene.device).plans
        self._turn_to_images(config.schedule.halves(1))
        self.whole = True

    @property
    def cameras(self) -> CameraRefinement | None:
        """The corrections of the training cameras; None where they are kept."""
        return self._learners.cameras

    def exposure_of(self, view: View) -> Tensor | None:
        """The correction (3, 4) of the colors of a training view; None where they are taken as they are."""
        return self._learners.exposure(view)

    @property
    def steps_are(self) -> str:
        """Where the steps are computed, and why, in words."""
        if self._resident is not None:
            return "resident: on the device from end to end"
        chosen = "the device is a CPU" if self.scene.device.is_cpu else "step_place says so"
        reason = why_exchange(self.config, self.parts) or chosen
        return f"exchange: by torch, since {reason}"

    def _turn_to_images(self, halved: bool) -> None:
        """Have the next steps see images of half the size, or whole ones."""
        if self._resident is not None:
            self._resident.settle()
        self._truth.halve(halved)
        camera = self._truth.camera(self.dataset.train[0].camera)
        self._drawn = (camera.width, camera.height, True)  # the kind of images that the steps draw
        self._plans.set_bands(self._drawn, 1)

    def close(self) -> None:
        """End what goes on beside the steps."""
        self._truth.close()

    def __enter__(self) -> "Trainer":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[StepResult]:
        while self.done < self.config.schedule.steps:
            yield self.step()

    def evaluate(self, views: Sequence[View] | None = None) -> dict[str, Any]:
        """Measure the scene on views, the test views where None: the content of metrics.json (docs/metrics.md).
        Training views are seen by their corrected cameras."""
        chosen = self.dataset.test if views is None else views
        seen = [dataclasses.replace(view, camera=self._learners.camera(view)) for view in chosen]
        return evaluate(self.scene, seen, self.config.data.background)

    def psnr(self, views: Sequence[View]) -> float:
        """The mean over views of the PSNR, dB, as `evaluate` measures it."""
        return float(self.evaluate(views)["psnr"])

    @property
    def initial_view(self) -> InitialView:
        """Where a viewer begins."""
        data = self.dataset
        camera = (data.test or data.train)[0].camera
        arc = captured_arc(camera, data.cameras, data.focus, data.up)
        return InitialView(camera, data.focus, data.up, data.time_count, arc)

    def save(self, path: str | Path) -> None:
        """Write a checkpoint (docs/format.md) to `path`, which lapgs-view and `load` open. Raises InputError."""
        data, view = self.dataset, self.initial_view.to_json()
        metadata = {"scene": data.name, "background": self.config.data.background, "step": str(self.done), "view": view}
        if data.normalization is not None:
            metadata["placement"] = data.normalization.to_json()
        self.scene.save(path, metadata)

    def step(self) -> StepResult:
        """One step of the optimizer, on one picture; then callbacks.

        A step whose loss or gradients are not finite moves nothing: parameters, the optimizers' and the density
        control's state stay as they were; what the schedule plans for this step is done. Raises NumericalError where
        too many are skipped, or where a parameter is not finite, and DeviceError.
        """
        with torch_threads(step_threads(self.config.field, self.scene.device)):
            result = self._step()
        for callback in self.callbacks:
            callback(self, result)
        return result

    def _step(self) -> StepResult:
        step = self.done + 1
        moving, share = step > self.warm_up_steps, self._share_of_rates(step)
        # Before this step draws: both may wait for steps in flight, which may draw again.
        if self._resident is not None:
            self._resident.settle(IN_FLIGHT - 1)
        if self._truth.halved != self.config.schedule.halves(step):
            self._turn_to_images(not self._truth.halved)
        timing, corrections = self.scene.timing, self.config.timing.corrections(self.config.schedule.steps)
        if self.timing is not None and moving and step in corrections:
            timing = self.timing.fitted(corrections.index(step))
        before = self._draws.mark()
        try:
            scheduled = Scheduled(step, moving, share, step < self.config.density.stop)
            measured = (self._resident or self._exchange).take(scheduled, self._began)
        except BaseException:
            if self.whole:  # the device gave out, or somebody broke it off: as if not begun
                self._draws.go_back(before)
            raise
        self.scene.timing = timing
        self._density.change(step, moving=moving)
        if step % self.config.schedule.sh_interval == 0:
            self.scene.sh_degree = min(self.scene.sh_degree + 1, MAX_SH_DEGREE)
        self.done = step
        self.whole = True
        if self._resident is None:
            self._count_skipped(measured())
        return StepResult(step, self.config.schedule.steps, measured)

    def _share_of_rates(self, step: int) -> float:
        """Which share of its learning rates a step has: they rise over the first steps, and fall over the last."""
        rising, steps = self._ramp_steps, self.config.schedule.steps
        falling, left = self.config.schedule.cool_down * steps, steps - step + 1
        return min(1.0, step / rising if rising else 1.0, left / falling if falling else 1.0)

    def _count_skipped(self, measured: Measured) -> None:
        """Count the skipped steps in a row. Raises NumericalError where too many in a row were."""
        self._skipped = 0 if measured.skipped is None else self._skipped + 1
        if self._skipped == MOST_SKIPPED:
            what = f"{MOST_SKIPPED} steps in a row had values that are not finite; the last: {measured.skipped}"
            raise NumericalError(what)

    def _began(self) -> None:
        self.whole = False

    def _roll_back_to(self, settled: int | None) -> None:
        """Go back to the end of a step: those behind it changed nothing, and an error ends them. None: no step is
        left to go back to."""
        self.whole = settled is not None
        self.done = self.done if settled is None else settled

    @torch.no_grad()
    def _picture(self, view: View, t: float) -> Tensor:
        """The scene's picture (H, W, 3) of a training view at a time of the field, with the corrections of its camera
        and of its colors."""
        camera, correction = self._truth.camera(self._learners.camera(view)), self.exposure_of(view)
        background = self._truth.backgrounds[view]
        image = self.scene.render_at_field_time(camera, t, background, depth=False).image
        return image if correction is None else image @ correction[:, :3].T + correction[:, 3]

    # The state between two steps -------------------------------------------------------------------------------------

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything that the next step depends on, by name; copies."""
        scene = self.scene
        parts: dict[str, Mapping[str, Tensor]] = {
            "gaussians": scene.parameters,
            "field": scene.field.state_dict() if scene.field else {},
            **self._learners.state(),
            "timing": {name: torch.from_numpy(array) for name, array in vars(scene.timing).items() if len(array)},
            "statistics": vars(self._density.statistics),
            "training": {
                "done": torch.tensor(self.done),
                "warm_up": torch.tensor(self.warm_up_steps),
                "rising": torch.tensor(self._ramp_steps),
                "field_fitted": torch.tensor(self._learners.field_fitted, dtype=torch.float64),
                "sh_degree": torch.tensor(scene.sh_degree),
                "random": self._draws.generator.get_state(),
                "order": torch.tensor(self._draws.left, dtype=torch.int64),
                "bands": torch.tensor(self._plans.bands(self._drawn)),
            },
        }
        return {
            f"{part}.{name}": t.numpy(force=True).copy()
            for part, tensors in parts.items()
            for name, t in tensors.items()
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Go on from what `state` gave. Raises KeyError, RuntimeError or ValueError where it belongs to a training of
        another configuration."""
        parts: dict[str, dict[str, Tensor]] = {}
        for name, array in state.items():
            part, _, rest = name.partition(".")
            parts.setdefault(part, {})[rest] = torch.tensor(array)
        scene = self.scene
        if parts["gaussians"].keys() != scene.parameters.keys():
            raise ValueError(f"it has Gaussians with {sorted(parts['gaussians'])}, not {sorted(scene.parameters)}")
        for name, value in parts["gaussians"].items():
            if value.shape[1:] != scene.parameters[name].shape[1:]:
                raise ValueError(f"its {name} have the shape {tuple(value.shape)}")
            self._learners.optimizer.reset(name, value)
        if scene.field is not None:
            scene.field.load_state_dict(parts["field"])
        self._learners.restore(parts)
        if timing := {name: value.numpy() for name, value in parts.get("timing", {}).items()}:
            scene.timing = Timing(**timing)
        self._density.statistics = Statistics(**parts["statistics"])
        own = parts["training"]
        self.done, scene.sh_degree = int(own["done"]), int(own["sh_degree"])
        self.warm_up_steps, self._ramp_steps = int(own["warm_up"]), int(own["rising"])
        self._learners.set_field_fitted(float(own["field_fitted"]))
        self._draws.go_back((own["random"], own["order"].tolist()))
        self._turn_to_images(self.config.schedule.halves(max(1, self.done)))
        self._plans.set_bands(self._drawn, int(own["bands"]))
