"""A training step by torch's autograd, which exchanges buffers with the kernels: on CPU devices, whose memory is
shared, and wherever torch computes a part of the step, such as a field or a loss of one's own."""

from __future__ import annotations

import math
from collections.abc import Callable

from lapgs_wgpu.train.density_control import DensityControl
from lapgs_wgpu.train.ground_truth import AHEAD, GroundTruth
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.nonfinite import Skipped, cause, check_parameters, finite
from lapgs_wgpu.train.objective import Objective, Sample, ViewResult
from lapgs_wgpu.train.step_result import Measured, Scheduled
from lapgs_wgpu.train.view_order import Draws


class ExchangeStep:
    """Takes the steps of a training: the gradients of its views, then the optimizers.

    Args:
        objective: whose loss is lowered.
        learners: that are moved.
        density: whose statistics take the views in.
        truth: of the views.
        draws: of the training.
    """

    def __init__(
        self, objective: Objective, learners: Learners, density: DensityControl, truth: GroundTruth, draws: Draws
    ) -> None:
        self._objective, self._learners, self._density = objective, learners, density
        self._truth, self._draws = truth, draws

    @property
    def dead_scales(self) -> float:
        """`Objective.dead_scales`."""
        return self._objective.dead_scales

    def take(self, scheduled: Scheduled, began: Callable[[], None]) -> Callable[[], Measured]:
        """Take a step; gives what it told.

        began: called before anything changes, and after the last error that leaves all as it was.
        Raises NumericalError where a parameter is not finite.
        """
        step, draws = scheduled.step, self._draws
        chosen, drawn = draws.next(), draws.mark()
        sample = self._objective.sample(*chosen, step, draws.generator, moving=scheduled.moving)
        self._truth.prefetch([sample.view, *draws.order.coming(AHEAD)])
        self._learners.zero_grad()
        result = self._descend(sample, step)
        what = self._not_finite(result, began)
        skipped = Skipped(step, sample.view.name, what) if what else None
        began()
        if skipped is None:
            self._learners.step(step, scheduled.share)
            # After the optimizer's step, so that no gradient is lost with the rows that change.
            if scheduled.seen:
                self._density.statistics.add(result.radii, result.d_means2d, sample.view.camera)
        else:
            self._learners.zero_grad()
            draws.go_back(drawn)
        measured = Measured(result.loss, result.psnr, skipped, result.terms)
        return lambda: measured

    def _descend(self, sample: Sample, step: int) -> ViewResult:
        """`Objective.descend` for a view, as its camera and its colors are corrected."""
        view = sample.view
        truth, camera = self._truth.on_device(view), self._learners.refined_camera(view)
        correction = self._learners.exposure(view)
        return self._objective.descend(sample, step, truth, camera, correction)

    def _not_finite(self, result: ViewResult, began: Callable[[], None]) -> str:
        """What is not finite in the loss and gradients of a step, for which it is skipped; "" where all is well.

        Raises NumericalError for a parameter, whose values a step cannot mend.
        """
        parameters, gradients = self._learners.parameters(), self._learners.gradients()
        gradients["the places in the image"] = [result.d_means2d]
        if math.isfinite(result.loss) and finite(parameters, gradients):
            return ""
        try:
            check_parameters(parameters)
        except Exception:
            began()
            raise
        return cause([result.terms], gradients)
