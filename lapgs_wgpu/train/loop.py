"""The training, from top to bottom: a configuration and a capture become a scene and its run folder."""

from __future__ import annotations

import dataclasses
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.init import initial_scales, random_points
from lapgs_wgpu.data.views import Dataset, ImageCache, View, composite
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.buffer import Buffer
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.first_look import FirstLook
from lapgs_wgpu.motion.dynamics import dynamics_loss
from lapgs_wgpu.motion.field import Nearby
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Background, Config, PointsConfig, SmoothnessConfig
from lapgs_wgpu.train.densify import Statistics, densify, reset_opacities
from lapgs_wgpu.train.evaluate import COLOURS, evaluate, write_metrics
from lapgs_wgpu.train.log import Log, environment
from lapgs_wgpu.train.memory import keep_freed_memory
from lapgs_wgpu.train.optimise import FrequencyOptimiser, Optimiser
from lapgs_wgpu.train.presets import write_toml
from lapgs_wgpu.train.render_loss import TruthCache, render_loss

MAX_SH_DEGREE = 3
AHEAD = 4  # pictures that are decoded before they are needed
RUN_FILES = ("config.toml", "log.jsonl", "metrics.json", "checkpoint.ply", "eval")


class Progress(NamedTuple):
    """A step that is done, of how many in all; loss, and PSNR in dB, of the view that it saw."""

    step: int
    steps: int
    loss: float
    psnr: float


# Takes over a training's steps, such as a viewer does: called with the scene, where to look at it from, and the steps,
# of which it takes as many as it likes, each one a step of the training. The rest follows when it returns.
Watch = Callable[[Scene4D, FirstLook, Iterator[Progress]], None]


def train(
    config: Config,
    dataset: Dataset,
    out: str | Path,
    *,
    device: Device | None = None,
    overwrite: bool = False,
    watch: Watch | None = None,
) -> Scene4D:
    """Train on a dataset, evaluate on its test views, and leave config.toml, log.jsonl, metrics.json, checkpoint.ply
    and eval/ in the folder `out`, which must be new or empty, or hold an earlier run when `overwrite` is set.

    device: the default adapter where None. The same configuration, pictures, adapter and driver give the same
    checkpoint to the last byte, watched or not. Raises InputError before anything is written where the input is not
    usable, and KeyboardInterrupt after Ctrl-C, when the checkpoint of the last whole step has been written.
    """
    out = Path(out)
    check_run_folder(out, overwrite=overwrite)
    keep_freed_memory()
    device = device or open_device()
    scene = Scene4D.from_points(
        *initial_points(config.points, config.seed),
        config.field,
        opacity=config.points.opacity,
        device=device,
        seed=config.seed,
    )
    look = FirstLook((dataset.test or dataset.train)[0].camera, dataset.focus, dataset.up, len(dataset.times))
    start_run_folder(out, config, device)
    with Log(out / "log.jsonl", config.schedule.steps) as log, _interruptible() as interrupted:
        steps = training_steps(config, dataset, scene, log, interrupted)
        if watch is not None:
            watch(scene, look, steps)
        for _ in steps:
            pass
        done, seconds = log.done, log.seconds

    metadata = {"scene": dataset.name, "background": config.data.background, "step": str(done), "view": look.to_json()}
    scene.save(out / "checkpoint.ply", metadata)
    if interrupted.is_set():
        raise KeyboardInterrupt(
            f"stopped after step {done} of {config.schedule.steps}; {out / 'checkpoint.ply'} holds it."
        )
    evaluate_run(out, scene, dataset, config.data.background, {"steps": done, "seconds": round(seconds, 3)})
    return scene


def training_steps(
    config: Config, dataset: Dataset, scene: Scene4D, log: Log, interrupted: threading.Event
) -> Iterator[Progress]:
    """The training itself: each turn of the iterator is one step of the optimiser, until `interrupted` is set."""
    generator = torch.Generator().manual_seed(config.seed)
    device = scene.device
    optimiser = Optimiser(
        scene.parameters, scene.field.parameter_groups() if scene.field else {}, config.rates.schedules()
    )
    spectrum = scene.spectrum
    frequencies = FrequencyOptimiser(spectrum, config.rates.frequencies, len(dataset.times) / 2) if spectrum else None
    # Cameras that all stand at one place have no extent; the scene's own size must serve.
    extent = dataset.extent or config.points.box
    statistics = Statistics(len(scene), scene.parameters["means"].device)
    schedule, density = config.schedule, config.density
    with Pictures(dataset.train, config.data.background, config.data.cache_gb, generator, device) as pictures:
        for step in range(1, schedule.steps + 1):
            view, truth, background = pictures.draw()
            moving = step > schedule.warm_up
            if moving:
                nearby = draw_nearby(config.smoothness, len(scene), view.time, generator)
                gaussians, smoothness = scene.deformed(view.time, nearby)
            else:
                gaussians, smoothness = scene.canonical(), None
            weights = config.loss.weights(warm=moving)
            rendering = render_loss(gaussians, view.camera, truth, background, weights, device)
            loss = rendering.loss
            if smoothness is not None:
                loss = loss + smoothness
            if moving and "dynamics" in scene.parameters:
                spread = dynamics_loss(scene.parameters["dynamics"], config.loss.dynamics_mode)
                loss = loss + config.loss.dynamics * spread
            optimiser.zero_grad()
            loss.backward()
            optimiser.step(step)
            if frequencies is not None:
                frequencies.step(step)

            # After the optimiser's step, so that no gradient is lost with the rows that change.
            if step < density.stop:
                statistics.add(rendering, view.camera)
            if density.changes_at(step):
                change = densify(
                    scene.parameters,
                    statistics,
                    density,
                    extent,
                    generator,
                    bound_sizes=step > density.reset_interval,
                )
                optimiser.edit_rows(change.keep, change.added)
                statistics = Statistics(len(scene), scene.parameters["means"].device)
            if density.resets_at(step):
                logits = reset_opacities(scene.parameters["opacity_logits"], density.reset_opacity)
                optimiser.reset("opacity_logits", logits)
            if step % schedule.sh_interval == 0:
                scene.sh_degree = min(scene.sh_degree + 1, MAX_SH_DEGREE)

            value = loss.item()
            log.step(step, value, rendering.psnr, len(scene), spectrum)
            yield Progress(step, schedule.steps, value, rendering.psnr)
            if interrupted.is_set():
                break


def draw_nearby(config: SmoothnessConfig, count: int, t: float, generator: torch.Generator) -> Nearby | None:
    """Where the field of `count` Gaussians is compared with itself in a step at time t; None where it is not."""
    chosen = round(config.share * count)
    if chosen == 0 or config.static == config.temporal == 0:
        return None
    rows = torch.randint(count, (chosen,), generator=generator)
    offsets = config.reach * (2 * torch.rand(chosen, 3, generator=generator) - 1)
    other = t + config.time_reach * (2 * float(torch.rand((), generator=generator)) - 1)
    return Nearby(rows, offsets, min(max(other, 0.0), 1.0), config.static, config.temporal)


def evaluate_run(
    out: Path, scene: Scene4D, dataset: Dataset, background: Background, training: dict[str, float]
) -> dict[str, object]:
    """Evaluate on the test views, and write metrics.json and eval/ of a run folder; returns the metrics."""
    (out / "eval").mkdir(exist_ok=True)
    metrics = {**evaluate(scene, dataset.test, background, out / "eval"), "training": training}
    write_metrics(out / "metrics.json", metrics)
    return metrics


def check_run_folder(out: Path, *, overwrite: bool) -> None:
    """InputError where a run cannot be written there."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; name a folder for the run with --out.")
    if overwrite or not out.exists():
        return
    if any(out.iterdir()):
        raise InputError(f"{out} is not empty; name another folder with --out, or replace its run with --overwrite.")


def start_run_folder(out: Path, config: Config, device: Device) -> None:
    """Make the folder, free of an earlier run's files, and write config.toml."""
    out.mkdir(parents=True, exist_ok=True)
    for name in RUN_FILES:
        if (out / name).is_dir():
            shutil.rmtree(out / name)
        else:
            (out / name).unlink(missing_ok=True)
    table = {**dataclasses.asdict(config), "record": environment(device)}
    with atomic_write(out / "config.toml") as file:
        file.write(write_toml(table).encode())


def initial_points(
    config: PointsConfig, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Random Gaussians in the box: points (N, 3), colours (N, 3) and scales (N,)."""
    points, colours = random_points(config.count, -config.box, config.box, seed)
    return points, colours, initial_scales(points)


class Pictures:
    """Training views in random order without replacement, epoch after epoch. A context manager.

    generator: where the order, and random backgrounds, are drawn from. cache_gb: bound on what is kept in memory, and
    on what is kept on the device.
    """

    def __init__(
        self,
        views: tuple[View, ...],
        background: Background,
        cache_gb: float,
        generator: torch.Generator,
        device: Device,
    ) -> None:
        self._colour = None if background == "random" else torch.full((3,), COLOURS[background])
        self._views = views if self._colour is None else tuple(_on_background(v, self._colour.numpy()) for v in views)
        self._cache = ImageCache(int(cache_gb * 1e9))
        self._truths = TruthCache(device, int(cache_gb * 1e9))
        self._generator = generator
        self._order: list[View] = []

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *_: object) -> None:
        self._cache.close()

    def draw(self) -> tuple[View, Buffer, Tensor]:
        """The next view, its picture on the device (for `render_loss`) and the background (3,) that it lies on."""
        if not self._order:
            self._order = [self._views[i] for i in torch.randperm(len(self._views), generator=self._generator).tolist()]
        view = self._order.pop(0)
        self._cache.prefetch(view for view in self._order[:AHEAD] if view not in self._truths)
        colour = torch.rand(3, generator=self._generator) if self._colour is None else self._colour
        return view, self._truths.get(view, partial(self._cache.get, view)), colour


def _on_background(view: View, colour: NDArray[np.float32]) -> View:
    """The view without transparency, so that it is laid on its background once and not at every step."""
    return dataclasses.replace(view, pixels=partial(_flat, view, colour))


def _flat(view: View, colour: NDArray[np.float32]) -> NDArray[np.uint8]:
    return composite(view.load(), colour)


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets, instead of an exception in the middle of a step; the second Ctrl-C is one."""
    interrupted = threading.Event()

    def note(signum: int, frame: FrameType | None) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = None
    with suppress(ValueError):  # only the main thread may listen to signals
        before = signal.signal(signal.SIGINT, note)
    try:
        yield interrupted
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
