"""How long a training takes on this machine: measured by a few steps of it, before it begins."""

from __future__ import annotations

import dataclasses
import time
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.data.views import Dataset, small_views
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.discovery.static_fit import static_config
from lapgs_wgpu.train.evaluate import evaluate
from lapgs_wgpu.train.initial_points import initial_points
from lapgs_wgpu.train.trainer import Trainer

# Gaussians of the two scenes that are timed, relative to `points.count`: as many as trainings often have that begin
# with a static fit (docs/results.md), and the limit of a plan.
USUAL, GROWTH = 0.75, 2.0
UNTIMED = 2  # steps first, at least, which compile kernels, allocate buffers and decode images
LEAST_STEPS, LEAST_SECONDS, MOST_STEPS = 4, 3.0, 40  # of a measurement; each step shows another image
VIEWS = 2  # test views that are timed


class Costs(NamedTuple):
    """Seconds on this machine. few, many: a step with USUAL and with GROWTH times `points.count` Gaussians. still: a
    step of the static fit with which motion discovery begins. picture: a rendering of a training view. view: the
    evaluation of a test view."""

    few: float
    many: float
    still: float
    picture: float
    view: float

    @property
    def step(self) -> float:
        """A step with a number of Gaussians in the middle."""
        return (self.few + self.many) / 2


def measure_costs(config: Config, dataset: Dataset, device: Device) -> Costs:
    """Time some steps of a training on a dataset. Nothing is written. Raises InputError and DeviceError."""
    small = small_views(dataset.train[:MOST_STEPS], config.discovery.size)
    still, _ = _timed(static_config(config), dataclasses.replace(dataset, train=tuple(small)), device, USUAL)
    few, _ = _timed(config, dataset, device, USUAL)
    many, scene = _timed(config, dataset, device, GROWTH)
    for train in dataset.train[:2]:  # the first is not timed
        begin = time.perf_counter()
        scene.render(train.camera, train.time, depth=False)
        picture = time.perf_counter() - begin
    views = dataset.test[: VIEWS + 1]
    unit = dataset.extent if config.cameras.refines(own_footage=dataset.own_footage) else None
    evaluate(scene, views[:1], config.data.background, camera_unit=unit)  # not timed
    begin = time.perf_counter()
    evaluate(scene, views[-VIEWS:], config.data.background, camera_unit=unit)
    taken = time.perf_counter() - begin
    return Costs(few, many, still, picture, taken / len(views[-VIEWS:]))


def _timed(config: Config, dataset: Dataset, device: Device, growth: float) -> tuple[float, Scene4D]:
    """Seconds of a step with `growth` times points.count Gaussians, the field moving them, and the scene."""
    scene = _scene(config, dataset, device, round(growth * config.points.count))
    rhythm = config.acceleration.interval if config.acceleration.weight else 1  # some steps have a further loss
    with Trainer(config, dataset, device, scene=scene) as trainer:
        for _ in range(max(UNTIMED, rhythm)):
            trainer.step()
        taken: list[float] = []
        while len(taken) < LEAST_STEPS or (sum(taken) < LEAST_SECONDS and len(taken) < MOST_STEPS):
            begin = time.perf_counter()
            for _ in range(rhythm):
                trainer.step()
            taken += rhythm * [(time.perf_counter() - begin) / rhythm]
    return float(np.median(taken)), scene


def _scene(config: Config, dataset: Dataset, device: Device, count: int) -> Scene4D:
    """`count` Gaussians where those of a training begin. Where it begins with fewer, more of them, and smaller ones,
    lie around the same places, so that they cover as much of the images."""
    points, colors, scales = initial_points(config.points, dataset, config.seed)
    random = np.random.default_rng(config.seed)
    rows = np.sort(np.resize(random.permutation(len(points)), count))
    offsets = scales[rows, None] * random.normal(size=(count, 3)).astype(np.float32)
    smaller = (len(points) / count) ** (1 / 2)
    return Scene4D.from_points(
        points[rows] + (offsets if count > len(points) else 0),
        colors[rows],
        scales[rows] * smaller,
        config.field,
        opacity=config.points.opacity,
        antialiased=config.antialiased,
        device=device,
        seed=config.seed,
    )
