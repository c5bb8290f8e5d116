"""The PSNR of held-out views while a training runs (eval.interval)."""

from __future__ import annotations

import time

from lapgs_wgpu.data.views import Dataset, spread_views
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.step_result import StepResult
from lapgs_wgpu.train.trainer import Trainer

TRAINING_VIEWS = 8  # that are measured where the capture has no validation views


class Monitor:
    """A callback of a training that logs the mean PSNR of the validation views, or of some training views, every
    eval.interval steps."""

    def __init__(self, dataset: Dataset, log: Log) -> None:
        self._name, self._views = "val", dataset.val
        if not dataset.val:
            self._name, self._views = "train", tuple(spread_views(dataset.train, TRAINING_VIEWS))
        self._log = log

    def __call__(self, trainer: Trainer, result: StepResult, /) -> None:
        if result.step % trainer.config.eval.interval == 0:
            start = time.perf_counter()
            psnr = trainer.psnr(self._views)
            self._log.evaluated(result.step, psnr, self._name, time.perf_counter() - start)
