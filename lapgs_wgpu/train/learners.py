"""Everything that learns in a training, and by what: the Gaussians, the field, and corrections of the images."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.camera_refinement import CameraRefinement, ScenePoints, scene_points
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.exposure import Exposures
from lapgs_wgpu.train.optimizer import FrequencyOptimizer, Optimizer
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.setup import Start, max_field_rates, nyquist_frequency


class Learners:
    """The optimizer of the Gaussians and the field, and what learns beside it.

    config, dataset, parts, scene: of the training. frequencies: of the motion spectrum; None where there is none.
    image_numbers: by name of a training view the number of its colors' correction. on_access: called before corrections
    are read or changed from outside: a device may have newer ones.
    """

    def __init__(self, config: Config, dataset: Dataset, parts: Parts, start: Start) -> None:
        self.config, self.dataset, self.parts = config, dataset, parts
        scene = self.scene = start.scene
        self._groups = scene.field.parameter_groups() if scene.field else {}
        rates = parts.rates_of(config.rates.schedules(), scene.parameters, self._groups)
        self.optimizer = Optimizer(scene.parameters, self._groups, rates)
        self.set_field_fitted(start.field_fitted)
        self.frequencies = None
        if scene.spectrum is not None:
            limit = nyquist_frequency(dataset)
            self.frequencies = FrequencyOptimizer(scene.spectrum, config.rates.frequencies, limit)
        self._exposures = self._cameras = None
        if config.exposure.enabled:
            count = len(dataset.cameras) if dataset.is_rig else len(dataset.train)
            self._exposures = Exposures(count, config.exposure.rate)
        if config.cameras.refine == "on" or (config.cameras.refine == "auto" and dataset.own_footage):

            def points() -> ScenePoints:
                return scene_points(scene.parameters["means"], scene.parameters["opacity_logits"].sigmoid())

            self._cameras = CameraRefinement(dataset.cameras, dataset.extent, config.cameras, points, start.corrections)
        self.on_access: Callable[[], None] = lambda: None
        of_camera = {camera: number for number, camera in enumerate(dataset.cameras)}
        self.image_numbers = {
            view.name: of_camera[view.camera] if dataset.is_rig else number for number, view in enumerate(dataset.train)
        }

    @property
    def cameras(self) -> CameraRefinement | None:
        """The corrections of the training cameras; None where they are kept."""
        self.on_access()
        return self._cameras

    @property
    def exposures(self) -> Exposures | None:
        """The corrections of the training images' colors; None where they are taken as they are."""
        self.on_access()
        return self._exposures

    def set_field_fitted(self, fitted: float) -> None:
        """Not 0 where discovery fitted the field to nearly all that moves: its rates are then held low (`Start`)."""
        self.field_fitted = fitted
        self.optimizer.highest = max_field_rates(self._groups, fitted) if fitted else {}

    def camera(self, view: View) -> Camera:
        """The camera of a view; that of a training view corrected, where it is."""
        cameras = self.cameras
        return cameras.refined(view.camera) if cameras and view.camera in cameras.numbers else view.camera

    def camera_change(self, view: View) -> Tensor | None:
        """(6,) zeros that get the gradient by a change of a training view's camera; None where it is kept."""
        cameras = self._cameras
        return None if cameras is None else cameras.values[cameras.numbers[view.camera]]

    def exposure(self, view: View) -> Tensor | None:
        """The correction (3, 4) of the colors of a training view; None where they are taken as they are."""
        exposures = self.exposures
        return None if exposures is None else exposures.values[self.image_numbers[view.name]]

    def parameters(self) -> dict[str, list[Tensor]]:
        """All that learns, by group."""
        return {**self.optimizer.parameters(), **{each.name: [each.values] for each in self._refiners()}}

    def gradients(self) -> dict[str, list[Tensor]]:
        """Of all parameters that have one, by group."""
        return {name: [p.grad for p in group if p.grad is not None] for name, group in self.parameters().items()}

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for group in self.parameters().values():
            for parameter in group:
                parameter.grad = None

    def step(self, step: int, share: float) -> None:
        """Move all that has a gradient, the Gaussians and the field at a share of the rates of this step."""
        self.optimizer.step(step, share)
        for each in self._refiners():
            each.step(step)

    def state(self) -> dict[str, Mapping[str, Tensor]]:
        """Everything that the next step depends on, besides the scene and the gradients, by part."""
        return {"adam": self.optimizer.state(), **{each.name: each.state() for each in self._refiners()}}

    def restore(self, state: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Go on from what `state` gave. Raises KeyError or ValueError where it is of another training."""
        self.optimizer.restore(state.get("adam", {}))
        for each in self._refiners():
            restore_tensors(each.state(), state[each.name], each.name)

    def _refiners(self) -> list[FrequencyOptimizer | Exposures | CameraRefinement]:
        return [each for each in (self.frequencies, self.exposures, self.cameras) if each is not None]


@torch.no_grad()
def restore_tensors(mine: Mapping[str, Tensor], state: Mapping[str, Tensor], of: str) -> None:
    """Copy a state that was stored into the tensors that are in use, a `square` and `steps` of Adam among them.

    of: what the values are, for the text of a ValueError, which is raised where the state is of another training.
    """
    for name, value in mine.items():
        other = state[name]
        if other.shape != value.shape or other.dtype != value.dtype or not bool(other.isfinite().all()):
            raise ValueError(f"its {of} {name} is {other.dtype} of shape {tuple(other.shape)}, or not finite")
    if bool((state["square"] < 0).any() or (state["steps"] < 0).any()):
        raise ValueError(f"its {of} moments are negative")
    for name, value in mine.items():
        value.copy_(state[name])
