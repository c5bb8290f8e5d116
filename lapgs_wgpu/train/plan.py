"""The training that suits this machine and a capture: preset, image size and number of steps, chosen by measurement."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import DeviceMemoryError, InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.progress import duration
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.open_dataset import open_dataset
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.step_costs import GROWTH, Costs, measure_costs

LARGE = {"one camera that moves": "hypernerf", "still cameras": "neu3d", "cameras all around": "dnerf"}
SMALL = {"one camera that moves": "hypernerf-tiny", "still cameras": "neu3d-tiny", "cameras all around": "tiny"}
PATIENCE = 60.0  # minutes that a training takes at most with a large preset, unless others are given
SEEN = 20  # steps for each moment of the clip, at least: what `tiny` has on D-NeRF's scenes
LEAST_SHARE = 0.4  # of a preset's steps; with less, a smaller size is better
LEAST_STEPS = 250  # below, nothing can be recognised
SMALLER = 0.6  # of the small preset's image size, where time is short


class Plan(NamedTuple):
    """config, dataset: of the training. preset: where it comes from. seconds, at_most: that it takes, with motion
    discovery, corrections of times and evaluation. text: what was chosen and why, a line."""

    config: Config
    dataset: Dataset
    preset: str
    seconds: float
    at_most: float
    text: str


class _Candidate(NamedTuple):
    preset: str
    size: int
    large: bool


def layout_of(dataset: Dataset) -> str:
    """How the cameras of a capture stand: a key of LARGE and SMALL."""
    if dataset.still_cameras:
        return "still cameras"
    return "one camera that moves" if dataset.own_footage or dataset.cloud is not None else "cameras all around"


def plan_training(
    folder: Path,
    opened: Dataset,
    device: Device,
    *,
    minutes: float | None = None,
    exposure: bool = False,
    measure: Callable[[Config, Dataset, Device], Costs] = measure_costs,
) -> Plan:
    """Choose the training of a capture.

    On a CPU device the small presets are tried, else the large ones first. The first one is taken whose schedule, or
    most of it, fits into the time. Its steps are those of its schedule, more where the clip has many moments, fewer
    where the time is short.

    Args:
        opened: the capture in the folder, with images of any size.
        minutes: that the training may take, the motion discovery and the evaluation at its end included; None for the
            whole schedule.
        exposure: whether the images' colors are corrected, one by one.
        measure: times the steps.

    Raises:
        InputError: the capture is not usable, or the time is too short for anything.
    """
    if minutes is not None and not 0 < minutes < math.inf:
        raise InputError(f"--minutes must be above 0, got {minutes:g}.")
    layout = layout_of(opened)
    candidates = _candidates(layout, _longer_side(opened), device)
    for candidate in candidates:
        last = candidate is candidates[-1]
        config, dataset = _open(folder, candidate.preset, candidate.size)
        config = dataclasses.replace(config, exposure=dataclasses.replace(config.exposure, enabled=exposure))
        try:
            costs = measure(config, dataset, device)
        except DeviceMemoryError:
            if last:
                raise
            continue
        rest, whole = _beside_steps(config, costs, dataset), config.schedule.steps
        allowed = minutes if minutes is not None else PATIENCE if candidate.large else math.inf
        fitting = _steps_within(60 * allowed, config, costs, rest) if allowed < math.inf else sys.maxsize
        steps = min(max(whole, SEEN * dataset.moments), fitting)
        if steps < LEAST_SHARE * whole and not last:
            continue
        if steps < LEAST_STEPS:
            needed = math.ceil(_seconds(LEAST_STEPS, config, costs, rest)[0] / 6) / 10
            raise InputError(
                f"{allowed:g} minutes are enough for {max(steps, 0)} steps on {device.info.name}, and at least "
                f"{LEAST_STEPS} are needed; give --minutes {needed:g} or more."
            )
        seconds = _seconds(steps, config, costs, rest)
        found = f"{layout}, {len(dataset.train)} images of {dataset.moments} moments"
        text = _text(candidate.preset, _longer_side(dataset), config, steps, seconds, costs, found, device)
        return Plan(scaled(config, steps), dataset, candidate.preset, *seconds, text)
    raise AssertionError("there is a last candidate")


def _candidates(layout: str, longer: int, device: Device) -> list[_Candidate]:
    """Presets and image sizes, the best one first. longer: side of the capture's images, pixels."""
    small, large = SMALL[layout], LARGE[layout]
    found = [] if device.is_cpu else [_Candidate(large, load_config(large).data.size, True)]
    size = min(load_config(small).data.size, longer)
    return [*found, _Candidate(small, size, False), _Candidate(small, max(1, round(SMALLER * size)), False)]


def _longer_side(dataset: Dataset) -> int:
    camera = dataset.train[0].camera
    return max(camera.width, camera.height)


def _open(folder: Path, preset: str, size: int) -> tuple[Config, Dataset]:
    config = load_config(preset, {"data.path": str(folder.resolve()), "data.size": size})
    limit = round(GROWTH * config.points.count)
    config = dataclasses.replace(config, density=dataclasses.replace(config.density, limit=limit))
    return config, open_dataset(config)


def _beside_steps(config: Config, costs: Costs, dataset: Dataset) -> float:
    """Seconds that do not change with the number of steps: the evaluation, and the corrections of times, as many with
    a scaled schedule, each of which draws an image of each moment three times."""
    corrections = len(config.timing.corrections(config.schedule.steps))
    return len(dataset.test) * costs.view + corrections * 3 * len(dataset.times) * costs.picture


def _steps_within(seconds: float, config: Config, costs: Costs, rest: float) -> int:
    per_step = costs.step + _discovery(config, costs)[0] / config.schedule.steps
    return int((seconds - rest) / per_step)


def _seconds(steps: int, config: Config, costs: Costs, rest: float) -> tuple[float, float]:
    """About and at most, of a whole training with `steps` steps: motion discovery, steps, and the rest."""
    about, most = (each * steps / config.schedule.steps for each in _discovery(config, costs))
    return about + steps * costs.step + rest, most + steps * costs.many + rest


def _discovery(config: Config, costs: Costs) -> tuple[float, float]:
    """About and at most, seconds of motion discovery with all steps of a preset: the static fit and, where something is
    found, the fit of the field, whose steps take less than those of the training."""
    if not config.discovery.enabled:
        return 0.0, 0.0
    still = config.discovery.steps * costs.still
    return still, still + config.discovery.field_steps * costs.step


def scaled(config: Config, steps: int) -> Config:
    """The configuration with `steps` steps, and all its schedules as much shorter or longer."""
    factor = steps / config.schedule.steps

    def stretched(value: Any, names: tuple[str, ...]) -> Any:
        return dataclasses.replace(value, **{name: max(1, round(factor * getattr(value, name))) for name in names})

    rates = {name: stretched(rate, ("steps",)) for name, rate in vars(config.rates).items() if hasattr(rate, "steps")}
    smoothness = dataclasses.replace(config.smoothness, start=round(factor * config.smoothness.start))
    return dataclasses.replace(
        config,
        schedule=dataclasses.replace(stretched(config.schedule, ("warm_up", "sh_interval")), steps=steps),
        rates=dataclasses.replace(config.rates, **rates),
        density=stretched(config.density, ("start", "stop", "interval", "reset_interval", "contribution_interval")),
        smoothness=smoothness,
        exposure=dataclasses.replace(config.exposure, rate=stretched(config.exposure.rate, ("steps",))),
        cameras=dataclasses.replace(
            stretched(config.cameras, ("start",)), rate=stretched(config.cameras.rate, ("steps",))
        ),
        timing=stretched(config.timing, ("start", "interval")),
        discovery=stretched(config.discovery, ("steps", "field_steps")),
    )


def _text(
    preset: str,
    side: int,
    config: Config,
    steps: int,
    seconds: tuple[float, float],
    costs: Costs,
    found: str,
    device: Device,
) -> str:
    """What was chosen and why. side: of the images. config: of the preset. seconds: about and at most. found: about the
    capture."""
    whole = config.schedule.steps
    why = "its schedule"
    if steps > whole:
        why = f"its schedule has {whole}; {SEEN} for each moment"
    elif steps < whole:
        why = f"of {whole}: what the time allows"
    kind = "a CPU device" if device.is_cpu else "a graphics card"
    about, most = (duration(value) for value in seconds)
    corrected = ", colors of each image corrected" if config.exposure.enabled else ""
    return (
        f"training: {preset} ({found}) with images of {side} pixels ({device.info.name}, {kind}), "
        f"{steps} steps ({why}){corrected}. {1e3 * costs.few:.0f} to {1e3 * costs.many:.0f} ms a step, measured here: "
        f"it will take about {about}, at most {most}."
    )
