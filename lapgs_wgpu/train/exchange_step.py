"""A training step by torch's autograd, which exchanges buffers with the kernels: on CPU devices, whose memory is
shared, and wherever torch computes a part of the step, such as a field or a loss of one's own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import torch
from torch import Tensor

from lapgs_wgpu.data.views import View
from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.ground_truth import GroundTruth
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.nonfinite import Skipped, cause, check_parameters, finite
from lapgs_wgpu.train.objective import Objective, Sample, ViewResult
from lapgs_wgpu.train.step_result import Measured


class ExchangeStep:
    """Takes the steps of a training: the gradients of its views, then the optimizers.

    Args:
        objective: whose loss is lowered.
        learners: that are moved.
        density: whose statistics take the views in.
        truth: of the views.
    """

    def __init__(self, objective: Objective, learners: Learners, density: DensityControl, truth: GroundTruth) -> None:
        self._objective, self._learners, self._density = objective, learners, density
        self._truth = truth

    @property
    def dead_scales(self) -> float:
        """`Objective.dead_scales`."""
        return self._objective.dead_scales

    def draw(self, view: View, background: Tensor, step: int, generator: torch.Generator, *, moving: bool) -> Sample:
        """`Objective.sample`."""
        return self._objective.sample(view, background, step, generator, moving=moving)

    def take(
        self, step: int, samples: list[Sample], share: float, *, seen: bool, began: Callable[[], None]
    ) -> Measured:
        """Take a step, counted from 1.

        Args:
            step: counted from 1.
            samples: of its views.
            share: of the learning rates.
            seen: whether density control takes the views in.
            began: called before anything changes, and after the last error that leaves all as it was.

        Raises:
            NumericalError: a parameter is not finite.
        """
        self._learners.zero_grad()
        statistics = self._density.nothing_seen()
        results, totals = [], Counter[str]()
        for sample in samples:
            result = self._descend(sample, step, share=len(samples))
            statistics.add(result.radii, result.d_means2d, sample.view.camera, scale=len(samples))
            results.append(result)
            totals.update({"loss": result.loss, "psnr": result.psnr, **result.terms})
        means = {name: total / len(samples) for name, total in totals.items()}
        loss, psnr = means.pop("loss"), means.pop("psnr")
        what = self._not_finite(results, loss, began)
        skipped = Skipped(step, ", ".join(sample.view.name for sample in samples), what) if what else None
        began()
        if skipped is None:
            self._learners.step(step, share)
            # After the optimizer's step, so that no gradient is lost with the rows that change.
            if seen:
                self._density.statistics.merge(statistics)
        else:
            self._learners.zero_grad()
        return Measured(loss, psnr, skipped, means)

    def _descend(self, sample: Sample, step: int, *, share: int) -> ViewResult:
        """`Objective.descend` for a view, as its camera and its colors are corrected."""
        view = sample.view
        truth, camera = self._truth.on_device(view), self._learners.refined_camera(view)
        correction = self._learners.exposure(view)
        return self._objective.descend(sample, step, truth, camera, correction, share=share)

    def _not_finite(self, results: list[ViewResult], loss: float, began: Callable[[], None]) -> str:
        """What is not finite in the loss and gradients of a step, for which it is skipped; "" where all is well.

        Raises NumericalError for a parameter, whose values a step cannot mend.
        """
        parameters, gradients = self._learners.parameters(), self._learners.gradients()
        gradients["the places in the image"] = [result.d_means2d for result in results]
        if math.isfinite(loss) and finite(parameters, gradients):
            return ""
        try:
            check_parameters(parameters)
        except Exception:
            began()
            raise
        return cause([result.terms for result in results], gradients)
