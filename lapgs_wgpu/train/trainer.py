"""The training, step by step, and everything that its next step depends on."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.io.initial_view import InitialView, captured_arc
from lapgs_wgpu.motion.fields.config import MIN_SCALE
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import Timing, checked_timing
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.train.camera_refinement import CameraRefinement, RefinedCamera, scene_points
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, Config
from lapgs_wgpu.train.dataloader import ImageLoader
from lapgs_wgpu.train.densify import Statistics
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.distributed import SINGLE_PROCESS, Ranks
from lapgs_wgpu.train.evaluate import evaluate, mean_psnr
from lapgs_wgpu.train.exposure import Exposures
from lapgs_wgpu.train.fused_loss import RenderLoss
from lapgs_wgpu.train.host_threads import step_threads, torch_threads
from lapgs_wgpu.train.loss_terms import check_terms
from lapgs_wgpu.train.nonfinite import SkipCounter, Skipped, cause, check_parameters, finite
from lapgs_wgpu.train.objective import TERMS, Objective, Sample
from lapgs_wgpu.train.open_dataset import open_dataset, resolve_data
from lapgs_wgpu.train.optimizer import FrequencyOptimizer, Optimizer
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.resolve_config import nyquist_frequency, resolve_decoder, resolve_for_dataset
from lapgs_wgpu.train.start import Start, max_field_rates, start_from_points
from lapgs_wgpu.train.step_result import StepResult
from lapgs_wgpu.train.timing_refinement import TimingRefinement, image_to_fit

MAX_SH_DEGREE = 3


class Trainer:
    """A training, step by step.

    A context manager, and an iterator of the steps that are left.

    Attributes:
        scene: as the last step left it.
        config: the configuration, resolved for the data and the device.
        user_config: the same before it was resolved for the data, but for the decoder's place; config.toml holds it.
        dataset: its test views are not touched by any step.
        parts: own field, losses, density control, learning rates and callbacks.
        done: number of the steps so far.
        warm_up_steps: number of the first steps without motion.
        callbacks: a list of functions of the trainer and the StepResult, called after each step.
        discovery: what motion discovery found, a sentence; None where it was left out.
        discovery_seconds: that it took; 0 where it was left out.
        cameras: the corrections of the training cameras; None where they are kept.
        timing: the corrections of the training images' times; None where they are kept.
        ranks: this process among those that train together.
        whole: False while a step is partly applied, and after an error in that part of it.
    """

    def __init__(
        self,
        config: Config,
        dataset: Dataset | None = None,
        device: Device | None = None,
        ranks: Ranks = SINGLE_PROCESS,
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
            ranks: this process among those that train together. The first one's start replaces those of the others.
            scene: to start from, and to move from the first step on. Its field keeps its shape, whatever config.field
                says.
            start: what motion discovery found.
            parts: own field, losses, density control, learning rates and callbacks.

        Raises:
            InputError: the configuration, the data, the scene and the parts do not fit each other.
        """
        parts = parts or Parts()
        check_arguments(config, dataset, parts, ranks)
        if dataset is None:
            config = resolve_data(config, Path("runs"))
            dataset = open_dataset(config)
        device = device or open_device()
        if scene is not None:
            _check_scene(scene, config, parts)
            start = Start(scene, ramp_steps=config.schedule.warm_up)
        self.user_config, self.config = resolved_configs(config, dataset, device, parts, scene)
        if start is None:
            start = start_from_points(self.config, dataset, device, parts.field)
        self.dataset, self.parts, self.callbacks = dataset, parts, list(parts.callbacks)
        self.ranks = ranks
        self.done = 0
        self._threads = step_threads(self.config.field, device)
        self.scene, self.discovery, self.discovery_seconds = start.scene, start.summary, start.seconds
        self.warm_up_steps, self._ramp_steps = start.warm_up_steps, start.ramp_steps
        self._generator = torch.Generator().manual_seed(config.seed)
        self._prepare(start)
        if ranks.count > 1:
            self.restore(ranks.of_first(self.state()))
        self.whole = True

    def _prepare(self, start: Start) -> None:
        """Make what the steps work with."""
        config, scene, dataset = self.config, self.scene, self.dataset
        if isinstance(scene.field, GridField):
            scene.field.on_device = config.decoder == "device"
        groups = scene.field.parameter_groups() if scene.field else {}
        rates = self.parts.rates_of(config.rates.schedules(), scene.parameters, groups)
        self._optimizer = Optimizer(scene.parameters, groups, rates)
        self._frequencies = None
        if scene.spectrum is not None:
            limit = nyquist_frequency(dataset)
            self._frequencies = FrequencyOptimizer(scene.spectrum, config.rates.frequencies, limit)
        self._exposures = Exposures(len(dataset.train), config.exposure.rate) if config.exposure.enabled else None
        extent = dataset.extent
        self._objective = Objective(config, scene, self.parts.losses, dataset.moments, extent)
        self._limit_field_rates(field_fitted=start.field_fitted)
        self.cameras = None
        if config.cameras.refines(own_footage=dataset.own_footage):
            self.cameras = CameraRefinement(
                dataset.cameras,
                extent,
                config.cameras,
                lambda: scene_points(scene.parameters["means"], scene.parameters["opacity_logits"].sigmoid()),
                start.corrections,
            )
        self._color = torch.full((3,), BACKGROUND_LEVELS[config.data.background])  # of the evaluation
        self.timing = None
        if config.timing.refine and scene.field is not None and len(dataset.times) > 2:
            truth = partial(image_to_fit, color=self._color)
            self.timing = TimingRefinement(scene, dataset.train, truth, self._picture, dataset.time_gap, self.ranks)
        refiners = (self._frequencies, self._exposures, self.cameras)
        self._refiners = [each for each in refiners if each is not None]
        self._density = DensityControl(
            config,
            scene,
            self._optimizer,
            self.parts.density,
            dataset.train,
            self._camera_of,
            extent,
            self._generator,
            self.ranks,
        )
        self._numbers = {view.name: number for number, view in enumerate(dataset.train)}
        self._skips = SkipCounter()
        data = config.data
        self._images = ImageLoader(dataset.train, data.background, data.cache_gb, self._generator, scene.device)
        self._plans, camera = rasterizer_of(scene.device).plans, dataset.train[0].camera
        self._drawn = (camera.width, camera.height, True)  # the kind of images that the steps draw
        self._plans.set_bands(self._drawn, 1)

    def _limit_field_rates(self, *, field_fitted: bool) -> None:
        """Hold the field's learning rates low where discovery has fitted it to nearly all that moves."""
        self._objective.field_fitted = field_fitted
        field = self.scene.field
        self._optimizer.highest = max_field_rates(field.parameter_groups()) if field_fitted and field else {}

    def close(self) -> None:
        """End what goes on beside the steps."""
        self._images.close()

    def __enter__(self) -> Trainer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[StepResult]:
        """Take the steps that are left, one at a time."""
        while self.done < self.config.schedule.steps:
            yield self.step()

    @property
    def dead_scales(self) -> float:
        """Of the last view that was rendered, the share of the Gaussians' scales that are at the floor, where they get
        no gradient."""
        return float((self._objective.scales <= MIN_SCALE).float().mean())

    def evaluate(self, views: Sequence[View] | None = None) -> dict[str, Any]:
        """Measure the scene on views, the test views where None: the content of metrics.json (docs/metrics.md).
        Training views are seen by their corrected cameras."""
        chosen = self.dataset.test if views is None else views
        return evaluate(self.scene, self._as_seen(chosen), self.config.data.background)

    def psnr(self, views: Sequence[View]) -> float:
        """The mean over views of the PSNR, dB, as `evaluate` measures it."""
        return mean_psnr(self.scene, self._as_seen(views), self.config.data.background)

    @property
    def initial_view(self) -> InitialView:
        """Where a viewer begins."""
        data = self.dataset
        camera = (data.test or data.train)[0].camera
        arc = captured_arc(camera, data.cameras, data.focus, data.up)
        return InitialView(camera, data.focus, data.up, data.moments, arc)

    def save(self, path: str | Path) -> None:
        """Write a checkpoint (docs/format.md) to `path`, which lapgs-view and `load` open. Raises InputError."""
        data, view = self.dataset, self.initial_view.to_json()
        metadata = {"scene": data.name, "background": self.config.data.background, "step": str(self.done), "view": view}
        if data.normalization is not None:
            metadata["placement"] = data.normalization.to_json()
        self.scene.save(path, metadata)

    def step(self) -> StepResult:
        """One step of the optimizer, on `schedule.batch` pictures, whose losses count as their mean; then callbacks.

        A step whose loss or gradients are not finite moves nothing: parameters, the optimizers' and the density
        control's state stay as they were; what the schedule plans for this step is done. Raises NumericalError where
        too many are skipped, or where a parameter is not finite, and DeviceError.
        """
        random, order = self._generator.get_state(), list(self._images.order)
        try:
            with torch_threads(self._threads):
                result = self._step()
        except BaseException:
            if self.whole:  # the device gave out, or somebody broke it off: as if the step had not begun
                self._generator.set_state(random)
                self._images.order = order
            raise
        for callback in self.callbacks:
            callback(self, result)
        return result

    def _step(self) -> StepResult:
        config, scene, ranks = self.config, self.scene, self.ranks
        step = self.done + 1
        moving = step > self.warm_up_steps
        # Every rank draws the numbers of all views, so that their random streams stay the same.
        chosen = [self._images.choose() for _ in range(config.schedule.batch)]
        drawn = self._generator.get_state()
        samples = [self._objective.sample(*each, step, self._generator, moving=moving) for each in chosen]

        self._zero_grad()
        seen = self._density.nothing_seen()
        renderings, totals = [], Counter[str]()
        for sample in samples[ranks.rank :: ranks.count]:
            loss, rendering, terms = self._loss(sample)
            (loss / len(samples)).backward()
            seen.add(rendering, sample.view.camera, scale=len(samples))
            renderings.append(rendering)
            totals.update({"loss": loss.item(), "psnr": rendering.psnr, **terms})
        if ranks.count > 1:
            self._all_reduce_gradients()
        sums = ranks.all_reduce_sum([torch.tensor(list(totals.values()), dtype=torch.float64)])[0] / len(samples)
        value, psnr, *of_terms = sums.tolist()

        names = ", ".join(sample.view.name for sample in samples)
        skipped = self._examine(renderings, value, step, names)
        moments, corrections = None, config.timing.corrections(config.schedule.steps)
        if self.timing is not None and moving and step in corrections:
            moments = self.timing.fitted(corrections.index(step))
        self.whole = False
        if skipped is None:
            self._optimizer.step(step, min(1.0, step / self._ramp_steps) if self._ramp_steps else 1.0)
            for refiner in self._refiners:
                refiner.step(step)
            # After the optimizer's step, so that no gradient is lost with the rows that change.
            if step < config.density.stop:
                self._density.statistics.merge(self._seen_by_all(seen))
        else:
            self._generator.set_state(drawn)
            self._zero_grad()
        if moments is not None and self.timing is not None:
            self.timing.set(moments)
        pruned = self._density.change(step, moving=moving)
        if step % config.schedule.sh_interval == 0:
            scene.sh_degree = min(scene.sh_degree + 1, MAX_SH_DEGREE)
        self.done = step
        self.whole = True
        self._skips.note(skipped)
        terms = dict(zip(list(totals)[2:], of_terms, strict=True))
        return StepResult(step, config.schedule.steps, value, psnr, skipped, terms, pruned)

    def _loss(self, sample: Sample) -> tuple[Tensor, RenderLoss, dict[str, float]]:
        """`Objective.loss` of a view, as its camera and its colors are corrected."""
        view = sample.view
        camera = RefinedCamera(view.camera, None) if self.cameras is None else self.cameras.refined(view.camera)
        return self._objective.loss(sample, self.done + 1, self._images.on_device(view), camera, self.exposure_of(view))

    def _camera_of(self, view: View) -> Camera:
        """The camera of a training view, corrected where it is."""
        return view.camera if self.cameras is None else self.cameras.refined(view.camera).camera

    def _as_seen(self, views: Sequence[View]) -> list[View]:
        """The views, those by cameras of the training with the corrections of these."""
        trained = set(self.dataset.cameras)
        return [
            dataclasses.replace(view, camera=self._camera_of(view)) if view.camera in trained else view
            for view in views
        ]

    def exposure_of(self, view: View) -> Tensor | None:
        """The correction (3, 4) of the colors of a training view; None where they are taken as they are."""
        return None if self._exposures is None else self._exposures.values[self._numbers[view.name]]

    @torch.no_grad()
    def _picture(self, view: View) -> Tensor:
        """The scene's picture (H, W, 3) of a training view, with the corrections of its camera and of its colors."""
        image = self.scene.render(self._camera_of(view), view.time, self._color, depth=False).image
        correction = self.exposure_of(view)
        return image if correction is None else image @ correction[:, :3].T + correction[:, 3]

    def _gradients(self) -> dict[str, list[Tensor]]:
        """By group, of all parameters that have one."""
        gradients = self._optimizer.gradients()
        return gradients | {each.name: [each.values.grad] for each in self._refiners if each.values.grad is not None}

    def _zero_grad(self) -> None:
        self._optimizer.zero_grad()
        for each in self._refiners:
            each.values.grad = None

    def _all_reduce_gradients(self) -> None:
        """Every rank's gradients become the sums over the ranks."""
        mine = [gradient for group in self._gradients().values() for gradient in group]
        for gradient, total in zip(mine, self.ranks.all_reduce_sum(mine), strict=True):
            gradient.copy_(total)

    def _seen_by_all(self, seen: Statistics) -> list[Statistics]:
        return [Statistics(*values) for values in zip(*self.ranks.all_gather(list(vars(seen).values())), strict=True)]

    def _examine(self, renderings: list[RenderLoss], loss: float, step: int, views: str) -> Skipped | None:
        """Whether the step of these gradients is to be skipped, and why. Raises NumericalError for a parameter, whose
        values a step cannot mend."""
        parameters, gradients = self._optimizer.parameters(), self._gradients()
        parameters |= {each.name: [each.values] for each in self._refiners}
        places = [each.means2d.grad for each in renderings if each.means2d.grad is not None]
        gradients |= {"the places in the image": places} if places else {}
        if not self.ranks.any_rank(not (math.isfinite(loss) and finite(parameters, gradients))):
            return None
        self.whole = False
        check_parameters(parameters)
        self.whole = True
        return Skipped(step, views, cause(loss, [each.terms for each in renderings], gradients))

    def camera_report(self) -> dict[str, Any] | None:
        """How far the training cameras were moved (`CameraRefinement.report`); None where they are kept."""
        return None if self.cameras is None else self.cameras.report()

    # The state between two steps -------------------------------------------------------------------------------------

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything that the next step depends on, by name; copies."""
        scene = self.scene
        parts: dict[str, Mapping[str, Tensor]] = {
            "gaussians": scene.parameters,
            "field": scene.field.state_dict() if scene.field else {},
            "adam": self._optimizer.state(),
            "frequencies": self._frequencies.state() if self._frequencies else {},
            "exposure": self._exposures.state() if self._exposures else {},
            "cameras": self.cameras.state() if self.cameras else {},
            "timing": self.timing.state() if self.timing else _timing_state(scene.timing),
            "statistics": vars(self._density.statistics),
            "training": {
                "done": torch.tensor(self.done),
                "warm_up": torch.tensor(self.warm_up_steps),
                "rising": torch.tensor(self._ramp_steps),
                "field_fitted": torch.tensor(int(self._objective.field_fitted)),
                "sh_degree": torch.tensor(scene.sh_degree),
                "random": self._generator.get_state(),
                "order": torch.tensor(self._images.order, dtype=torch.int64),
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
            self._optimizer.reset(name, value)
        if scene.field is not None:
            scene.field.load_state_dict(parts["field"])
        self._optimizer.restore(parts.get("adam", {}))
        if self._frequencies is not None:
            self._frequencies.restore(parts["frequencies"])
        if self._exposures is not None:
            self._exposures.restore(parts["exposure"])
        if self.cameras is not None:
            self.cameras.restore(parts["cameras"])
        timing = parts.get("timing", {})
        if self.timing is not None:
            self.timing.restore(timing)
        elif timing:
            scene.timing = checked_timing(timing["times"].numpy(), timing["moments"].numpy())
        self._density.statistics = Statistics(**parts["statistics"])
        own = parts["training"]
        self.done, scene.sh_degree = int(own["done"]), int(own["sh_degree"])
        self.warm_up_steps = int(own.get("warm_up", self.warm_up_steps))  # older states lack it, and the next one
        self._ramp_steps = int(own.get("rising", self.config.schedule.warm_up - self.warm_up_steps))
        if self._ramp_steps < 0:
            raise ValueError("its rates rise over a negative number of steps")
        self._limit_field_rates(field_fitted=bool(own.get("field_fitted", False)))
        self._generator.set_state(own["random"])
        self._images.order = own["order"].tolist()
        self._plans.set_bands(self._drawn, int(own.get("bands", 1)))


def _timing_state(timing: Timing) -> dict[str, Tensor]:
    """Of a scene that began with a timing, which this training does not change."""
    return {name: torch.from_numpy(values) for name, values in vars(timing).items() if len(values)}


def check_arguments(config: Config, dataset: Dataset | None, parts: Parts, ranks: Ranks) -> None:
    """Raises InputError for arguments of a Trainer that are of another kind, or that exclude each other."""
    for name, kind, given in (("config", Config, config), ("dataset", Dataset | None, dataset)):
        if not isinstance(given, kind):
            raise InputError(f"Trainer takes as {name} what load_{name} gives, got a {type(given).__name__}.")
    check_terms(tuple(parts.losses), TERMS)
    if config.schedule.batch % ranks.count:
        raise InputError(
            f"{ranks.count} processes cannot share {config.schedule.batch} views a step evenly; give --batch "
            f"{ranks.count}, or a multiple of it."
        )


def _check_scene(scene: Scene4D, config: Config, parts: Parts) -> None:
    """Raises InputError for a scene from which a training cannot start."""
    if parts.field is not None:
        raise InputError("the scene to start from keeps its own field; leave out Parts(field=...).")
    if scene.antialiased != config.antialiased:
        raise InputError(
            f"the scene to start from is drawn with antialiased = {scene.antialiased}, and the configuration says "
            f"{config.antialiased}; give the configuration the scene's."
        )


def resolved_configs(
    config: Config, dataset: Dataset, device: Device, parts: Parts, scene: Scene4D | None = None
) -> tuple[Config, Config]:
    """The configuration with its field and decoder decided, as config.toml holds it; and resolved for the data, too.

    The field is that of the scene or of the parts, where they bring one. Raises InputError.
    """
    if scene is not None:
        config = dataclasses.replace(config, field=scene.field_config)
    elif parts.field is not None:
        try:
            config = dataclasses.replace(config, field=dataclasses.replace(config.field, kind="own"))
        except ValueError as error:
            raise InputError(f"{error}.") from None
    user_config = resolve_decoder(config, device)
    resolved = resolve_for_dataset(user_config, dataset)
    if scene is not None:  # whose field does not change its shape any more
        resolved = dataclasses.replace(resolved, field=scene.field_config)
    return user_config, resolved
