"""Callbacks that watch a training: the PSNR of held-out views, and snapshots of the scene."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from lapgs_wgpu.data.views import Dataset, View, spread_views
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.dataclass_table import did_you_mean
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.step_result import StepResult
from lapgs_wgpu.train.trainer import Trainer

SOME = 8  # training views that are measured where nobody chose others


def monitored_views(dataset: Dataset, wanted: str) -> tuple[str, Sequence[View]]:
    """The views that are measured during a training, and their name in log.jsonl. wanted: as eval.views. Never a test
    view, unless data.split made validation views of them. Raises InputError."""
    if wanted == "val" and not dataset.val:
        raise InputError("eval.views is val, but the capture has no views for validation (transforms_val.json).")
    if dataset.val and wanted in ("auto", "val"):
        return "val", dataset.val
    if wanted in ("auto", "train"):
        return "train", spread_views(dataset.train, SOME)
    known = {view.name: view for view in (*dataset.train, *dataset.val)}
    names = list(dict.fromkeys(name.strip() for name in wanted.split(",")))
    for name in names:
        if name not in known and any(name == view.name for view in dataset.test):
            raise InputError(f"eval.views names {name!r}, a test view; those are measured after the training only.")
        if name not in known:
            hint = did_you_mean(name, known, f"; they go from {next(iter(known))} to {list(known)[-1]}.")
            raise InputError(f"eval.views names {name!r}, which is no training or validation view{hint}")
    return wanted, [known[name] for name in names]


def without_effect(config: Config) -> list[str]:
    """A sentence for each option of eval that asks for what will not be done."""
    steps, found = config.schedule.steps, []
    if late := sorted(step for step in config.eval.snapshot_steps if not 0 < step <= steps):
        found.append(f"eval.snapshots names step {late[0]}, which is none of the {steps} steps of schedule.steps.")
    if config.eval.views != "auto" and not config.eval.interval:
        found.append("eval.views has no effect, since eval.interval is 0.")
    return found


class Monitor:
    """Logs the mean PSNR of some views every eval.interval steps. views: as `monitored_views` gives them."""

    def __init__(self, views: tuple[str, Sequence[View]], log: Log) -> None:
        self._name, self._views = views
        self._log = log

    def __call__(self, trainer: Trainer, result: StepResult, /) -> None:
        if result.step % trainer.config.eval.interval:
            return
        started = time.perf_counter()
        psnr = trainer.psnr(self._views)
        self._log.evaluated(result.step, psnr, self._name, time.perf_counter() - started)


class Snapshots:
    """Saves the scene to FOLDER/step_NNNNNN.ply at the steps of eval.snapshots, for lapgs-view."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, trainer: Trainer, result: StepResult, /) -> None:
        if result.step in trainer.config.eval.snapshot_steps:
            if self._folder.is_symlink():
                raise InputError(f"{self._folder} is a link, and snapshots are written into the run's own folder only.")
            self._folder.mkdir(exist_ok=True)
            trainer.save(self._folder / f"step_{result.step:06d}.ply")
