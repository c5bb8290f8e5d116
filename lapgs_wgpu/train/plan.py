"""The training that suits this machine and a capture: preset and number of steps, chosen by a measured step."""

import math
import operator
import time
from pathlib import Path
from typing import NamedTuple

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import DeviceMemoryError, InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.progress import duration
from lapgs_wgpu.train.config import Config, changed
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import open_data, start_from_points
from lapgs_wgpu.train.trainer import Trainer

FILM, MASKS = "a film with masks of what moves", "masks"  # the latter is lapgs-prepare's folder of them
# By the arrangement of the cameras: the large preset, and the small one.
PRESETS = {
    FILM: ("film-full", "film"),
    "one moving camera": ("hypernerf", "hypernerf-tiny"),
    "static cameras all around": ("rig-full", "rig"),
    "static cameras": ("neu3d", "neu3d-tiny"),
    "cameras all around": ("dnerf", "tiny"),
}
PATIENCE = 60.0  # minutes that a training with a large preset may take, unless others are given
STEPS_PER_TIME = 20  # steps for each time of the clip, at least: what `tiny` has on D-NeRF's scenes
LEAST_SHARE = 0.4  # of a large preset's steps; with fewer, the small preset is better
LEAST_STEPS = 250  # below, nothing can be recognized
# Time of a whole training by the time of its steps: motion discovery, growing numbers of Gaussians and the evaluation
# take 10 to 90 % more.
WHOLE = 1.5
# Keys of the lengths of a schedule that are 1 step at least.
LENGTHS = (
    *(f"rates.{name}.steps" for name in ("means", "hash", "mlp", "frequencies")),
    *("schedule.warm_up", "schedule.sh_interval", "exposure.rate.steps", "cameras.start", "cameras.rate.steps"),
    *(f"density.{name}" for name in ("start", "stop", "interval", "reset_interval", "contribution_interval")),
    *("timing.start", "timing.interval", "discovery.steps", "discovery.field_steps"),
)
UNTIMED_STEPS, TIMED_STEPS = 4, 8  # the first ones compile kernels; multiples of acceleration.interval


class Plan(NamedTuple):
    """config, dataset: of the training. seconds: that it takes, about. text: what was chosen and why, a line."""

    config: Config
    dataset: Dataset
    seconds: float
    text: str


def camera_layout(dataset: Dataset) -> str:
    """How the cameras of a capture are arranged: a key of PRESETS other than FILM."""
    if dataset.still_cameras:
        return "static cameras all around" if dataset.is_surrounded else "static cameras"
    return "one moving camera" if dataset.own_footage or dataset.cloud is not None else "cameras all around"


def step_seconds(config: Config, dataset: Dataset, device: Device) -> float:
    """Time some steps of a training with `points.count` moving Gaussians: the mean, seconds. Writes nothing. Raises
    InputError and DeviceError."""
    config = changed(config, {"schedule.half_size_steps": 0})
    with Trainer(config, dataset, device, scene=start_from_points(config, dataset, device).scene) as trainer:
        for count in (UNTIMED_STEPS, TIMED_STEPS):
            start = time.perf_counter()
            for _ in range(count):
                trainer.step()
        return (time.perf_counter() - start) / TIMED_STEPS


def plan_training(
    folder: Path, opened: Dataset, device: Device, *, minutes: float | None = None, exposure: bool = False
) -> Plan:
    """Choose the training of a capture: a small preset on a CPU device; on others a large one, where most of its
    schedule fits into the time. The steps are the schedule's, more for many times, fewer where the time is short.

    opened: the capture of the folder, with images of any size. minutes: that the training may take, about; None for the
    whole schedule. exposure: whether to learn a color correction for each image. Raises InputError where the capture is
    not usable, or the time is too short for anything.
    """
    if minutes is not None and not 0 < minutes < math.inf:
        raise InputError(f"--minutes must be above 0, got {minutes:g}.")
    layout = camera_layout(opened)
    if layout == "one moving camera" and (folder / MASKS).is_dir():
        layout = FILM
    for preset in PRESETS[layout][1:] if device.is_cpu else PRESETS[layout]:
        last = preset == PRESETS[layout][1]
        config = load_config(preset, {"data.path": str(folder), "exposure.enabled": exposure})
        # No densification beyond twice the initial number, so that the measured step tells of the whole training.
        config, dataset = open_data(changed(config, {"density.limit": 2 * config.points.count}))
        try:
            step = step_seconds(config, dataset, device)
        except DeviceMemoryError:
            if last:
                raise
            continue
        limit = minutes or (math.inf if last else PATIENCE)
        whole = config.schedule.steps
        steps = round(min(max(whole, STEPS_PER_TIME * dataset.time_count), 60 * limit / (WHOLE * step)))
        if last or steps >= LEAST_SHARE * whole:
            break
    if steps < LEAST_STEPS:
        needed = math.ceil(WHOLE * step * LEAST_STEPS / 6) / 10
        raise InputError(
            f"{limit:g} minutes are enough for {steps} steps on {device.info.name}, and at least {LEAST_STEPS} are "
            f"needed; give --minutes {needed:g} or more."
        )
    seconds = WHOLE * step * steps
    text = (
        f"training: {preset} ({layout}, {len(dataset.train)} images of {dataset.time_count} times), {steps} steps (its "
        f"schedule has {whole}){', colors of each image corrected' if exposure else ''}. A step takes {1e3 * step:.0f} "
        f"ms on {device.info.name}: the training will take about {duration(seconds)}."
    )
    return Plan(scale_schedule(config, steps), dataset, seconds, text)


def scale_schedule(config: Config, steps: int) -> Config:
    """The configuration with `steps` steps, and all its schedules as much shorter or longer."""
    factor = steps / config.schedule.steps
    scaled = {key: max(1, round(factor * operator.attrgetter(key)(config))) for key in LENGTHS}
    for key in ("schedule.half_size_steps", "smoothness.start"):
        scaled[key] = round(factor * operator.attrgetter(key)(config))
    return changed(config, scaled | {"schedule.steps": steps})
