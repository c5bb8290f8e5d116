"""The step that stays on the device, against the one by torch; and what it does where something goes wrong."""

import dataclasses
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import open_test_device
from helpers import sampled_rows
from helpers.interrupts import after_step
from helpers.scenes import relative
from helpers.training import configure
from torch import Tensor

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.views import View
from lapgs_wgpu.errors import DeviceLostError, DeviceMemoryError, InputError
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.motion.fields.deformation import Nearby, TimeSamples
from lapgs_wgpu.run import resume, train
from lapgs_wgpu.splat import buffer_plan
from lapgs_wgpu.splat.drawing import Drawing
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.resident_parameters import PARTS
from lapgs_wgpu.train.resident_passes import Recorded, ResidentPasses, Task
from lapgs_wgpu.train.run_folder import load_state
from lapgs_wgpu.train.step_result import Scheduled, StepResult
from lapgs_wgpu.train.trainer import Trainer

pytestmark = pytest.mark.kernels
SMALL = {"points__count": "150", "acceleration__interval": "1", "schedule__warm_up": "0"}
KINDS = {
    "laplacian": {},
    "opacity, too": {"field__appearance": "color+opacity"},
    "mirrored scales": {"field__negative_scales": "mirror"},
    "no appearance": {"field__appearance": "none"},
    "no dynamics": {"field__dynamics": "0"},
    "no temporal grids": {"field__temporal_hash": "false"},
    "corrections": {"cameras__refine": "on", "cameras__start": "1", "exposure__enabled": "true"},
    "backgrounds": {"data__vary_background": "true"},
    "half size": {"schedule__half_size_steps": "7"},
}


def started(config: Config, dataset: Dataset, device: Device, step: str) -> Trainer:
    return Trainer(dataclasses.replace(config, step_place=step), dataset, device)


def disturb(trainer: Trainer) -> None:
    """Give every parameter a value that everything depends on; the same in each call."""
    generator = torch.Generator().manual_seed(7)
    scene = trainer.scene
    with torch.no_grad():
        for name, tensor in sorted(scene.parameters.items()):
            tensor += 0.2 * torch.randn(tensor.shape, generator=generator)
            if name == "log_scales":
                tensor[:5] = -20.0  # below the floor
        if scene.field is not None:
            for name, tensor in sorted(scene.field.named_parameters()):
                # grid4d must move so unevenly that the acceleration's direction is not that of a rounding error.
                size = 2.0 if name.endswith(".table") and scene.field.config.kind == "grid4d" else 0.2
                tensor += size * torch.randn(tensor.shape, generator=generator)
            scene.field.heads.weight *= 0.3
    scene.sh_degree = 2
    if trainer.cameras is not None:
        for tensor in (trainer.cameras.state()["learnt"], trainer._learners.exposures.values.detach()):
            tensor += 0.02 * torch.randn(tensor.shape, generator=generator)


def by_resident(trainer: Trainer, task: Task) -> dict[str, Tensor]:
    step, parameters, corrections = (
        trainer._resident,
        trainer._resident.parameters,
        trainer._resident._passes.corrections,
    )
    parameters.record_adam = corrections.record_step = lambda *given, **more: None  # the gradients stay
    step._submit(task)
    gradients = {name: torch.zeros_like(t) for part in PARTS for name, t in parameters._tensors[part].items()}
    for part in PARTS:
        parameters._read(part, "gradient", gradients)
    if trainer.cameras is not None:
        for name, array in (("cameras", corrections._d_camera), ("exposure", corrections._d_exposure)):
            gradients[name] = torch.from_numpy(array.read())
    return gradients


def by_torch(trainer: Trainer, sample: Task, *, moving: bool) -> dict[str, Tensor]:
    nearby = times = None
    smooth = trainer.config.smoothness
    if sample.near.count:
        chosen, offsets = sampled_rows.rows(sample.near), sampled_rows.offsets(sample.near)
        nearby = Nearby(chosen, offsets, sample.near_time, smooth.static, smooth.temporal)
    if sample.even.count:
        times = TimeSamples(sampled_rows.rows(sample.even), sample.even_times)
    trainer._exchange._descend(Scheduled(4, moving, 1.0, seen=True), sample.view, sample.time, nearby, times)
    scene = trainer.scene
    named = {**scene.parameters, **(dict(scene.field.named_parameters()) if scene.field else {})}
    gradients = {name: torch.zeros_like(p) if p.grad is None else p.grad for name, p in named.items()}
    if trainer.cameras is not None:
        d_camera = trainer.cameras.values.grad.sum(dim=0).reshape(2, 3)
        gradients["cameras"] = torch.nn.functional.pad(d_camera, (0, 1)).flatten()
        gradients["exposure"] = trainer._learners.exposures.values.grad.sum(dim=0).flatten()
    return gradients


@pytest.mark.parametrize("kind", [*KINDS, "grid4d", "static", "warm-up"])
def test_gradients_are_those_of_torch(device: Device, dataset: Dataset, kind: str) -> None:
    method = kind if kind in ("grid4d", "static") else "laplacian"
    config = configure(method, **SMALL, **KINDS.get(kind, {}))
    moving = kind not in ("static", "warm-up")
    trainers = [started(config, dataset, device, step) for step in ("resident", "exchange")]
    for trainer in trainers:
        disturb(trainer)
    resident = trainers[0]._resident
    task = resident._task(Scheduled(4, moving, 1.0, seen=True))
    assert bool(task.near.count) == bool(task.even.count) == moving
    mine, expected = by_resident(trainers[0], task), by_torch(trainers[1], task, moving=moving)
    assert mine.keys() == expected.keys()
    # SwiftShader's exp is off by more, which the losses' signs of small differences make larger.
    bounds = {"SwiftShader": 2e-3, "llvmpipe": 1e-5}
    bound = next((bound for name, bound in bounds.items() if name in device.info.name), 3e-5)
    for name, exact in expected.items():
        if exact.abs().max() == 0:
            assert mine[name].abs().max() == 0, name
        else:
            assert relative(mine[name], exact) < bound, name


@pytest.mark.parametrize("kind", ["laplacian", "static", "corrections", "half size"])
def test_steps_are_those_of_torch(device: Device, dataset: Dataset, data: Path, kind: str) -> None:
    """Without what each draws by itself, over steps with and without motion, density control and a rising degree."""
    given = {"points__count": "150", "smoothness__share": "0", "acceleration__weight": "0", **KINDS.get(kind, {})}
    config = configure("static" if kind == "static" else "laplacian", data__path=str(data), **given)
    trainers = [started(config, dataset, device, step) for step in ("resident", "exchange")]
    results = [[trainer.step() for _ in range(10)] for trainer in trainers]
    if kind == "corrections":  # before density control, whose ties may fall another way
        mine, other = (trainer._learners.state() for trainer in trainers)
        assert relative(mine["cameras"]["learnt"], other["cameras"]["learnt"]) < 0.1
        exposures = [part["exposure"]["values"].detach() - torch.eye(3, 4) for part in (mine, other)]
        assert relative(*exposures) < 0.1
    for trainer, steps in zip(trainers, results, strict=True):
        steps.extend(trainer.step() for _ in range(10))
    for mine, other in zip(*results, strict=True):
        assert mine.loss == pytest.approx(other.loss, rel=5e-2 if mine.step > 10 else 1e-4), mine.step
        assert mine.terms.keys() == other.terms.keys()
    counts = [len(trainer.scene) for trainer in trainers]
    assert counts[0] == pytest.approx(counts[1], rel=0.1)


def test_a_resumed_training_and_one_that_was_looked_at_end_with_the_same_bytes(
    device: Device, dataset: Dataset, data: Path, tmp_path: Path
) -> None:
    config = configure(data__path=str(data), **KINDS["corrections"])
    straight, watched = (started(config, dataset, device, "resident") for _ in range(2))
    for _ in straight:
        pass
    for number in range(17):
        watched.step()
        if number % 5 == 2:
            watched.scene.at(0.3)
            watched.save(tmp_path / "now.ply")
    resumed = started(config, dataset, device, "resident")
    resumed.restore(watched.state())
    for _ in resumed:
        pass
    state, again = straight.state(), resumed.state()
    assert state.keys() == again.keys()
    assert [name for name in state if not np.array_equal(state[name], again[name])] == []


def test_what_nobody_reads_stays_on_the_device(device: Device, dataset: Dataset, data: Path) -> None:
    """Pictures are drawn there, and a change of the Gaussians leaves the field alone."""
    trainer = started(configure(data__path=str(data), schedule__warm_up="0"), dataset, device, "resident")
    steps(trainer, 3)
    scene, parameters = trainer.scene, trainer._resident.parameters
    with torch.no_grad():
        drawn = scene.at(0.3)
    assert parameters.values_on_host == parameters.state_on_host == set()
    trainer._learners.optimizer.edit_rows(torch.arange(len(scene)).flip(0))
    assert parameters.values_on_host == parameters.state_on_host == {"gaussians"}
    exact = scene.at(0.3)  # by torch, since it is differentiable
    assert parameters.values_on_host == {"gaussians", "field"}
    for name, values in exact.arrays().items():
        assert relative(drawn.arrays()[name].flip(0), values.detach()) < 1e-5, name


def test_what_a_callback_edits_counts(device: Device, dataset: Dataset, data: Path) -> None:
    """The same bytes whether steps are in flight or not."""
    config = configure(data__path=str(data), schedule__steps="12", schedule__warm_up="2")
    states = []
    for callbacks, wait in (([edits], False), ([edits], True), ([], False)):
        trainer = started(config, dataset, device, "resident")
        trainer.callbacks += callbacks
        for _ in trainer:
            if wait:
                trainer._resident.settle()
        states.append(trainer.state())
    assert [name for name in states[0] if not np.array_equal(states[0][name], states[1][name])] == []
    assert not np.array_equal(states[2]["gaussians.opacity_logits"], states[0]["gaussians.opacity_logits"])


@torch.no_grad()
def edits(trainer: Trainer, result: StepResult) -> None:
    if result.step in (4, 5, 9):
        trainer.scene.parameters["opacity_logits"] -= 0.5
        trainer.scene.field.heads.weight *= 0.9


@pytest.mark.parametrize("how", ["Ctrl-C", "lost", "memory", pytest.param("killed", marks=pytest.mark.nightly)])
def test_a_run_that_ends_with_steps_in_flight_goes_on_to_the_same_bytes(
    device: Device, configuration: str, data: Path, tmp_path: Path, how: str
) -> None:
    """After Ctrl-C from the last step; after the loss of the device or SIGKILL from the last saved state; where memory
    gives out because intersections outgrow it, from the last step that was waited for."""
    dataset, out = load_dataset(data), tmp_path / "run"
    config = dataclasses.replace(configure(schedule__steps="16", schedule__save_interval="6"), step_place="resident")
    train(config, dataset, tmp_path / "whole", device=device)
    if how == "killed":  # another process, whose driver dies with it
        call = f"import test_resident_step as t; t.ends(t.Path({str(data)!r}), t.Path({str(out)!r}), {configuration!r})"
        paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        ended = subprocess.run([sys.executable, "-c", call], cwd=Path(__file__).parent, env=paths, check=False)
        assert ended.returncode == -signal.SIGKILL
    else:
        with pytest.raises((KeyboardInterrupt, DeviceLostError, DeviceMemoryError)) as raised:
            ends(data, out, configuration, how)
        assert how != "lost" or f"--resume {out} goes on from the state that was saved last" in str(raised.value)
    assert load_state(out)["training.done"] == {"Ctrl-C": 11, "lost": 6, "memory": 11, "killed": 6}[how]
    resume(config, dataset, out, device=device)
    assert (out / "checkpoint.ply").read_bytes() == (tmp_path / "whole" / "checkpoint.ply").read_bytes()


def ends(data: Path, out: Path, configuration: str, how: str = "killed") -> None:
    """A training that ends after step 11, with steps in flight."""
    config = dataclasses.replace(configure(schedule__steps="16", schedule__save_interval="6"), step_place="resident")
    broken = open_test_device(configuration)
    with pytest.MonkeyPatch.context() as patched:
        what = {
            "Ctrl-C": lambda: signal.raise_signal(signal.SIGINT),
            "lost": broken.wgpu_device.destroy,
            "memory": lambda: no_memory(rasterizer_of(broken), patched),
            "killed": lambda: signal.raise_signal(signal.SIGKILL),
        }
        after_step(11, what[how], patched)
        train(config, load_dataset(data), out, device=broken)


def test_what_was_recorded_is_right_when_gaussians_go_and_sizes_change(
    device: Device, dataset: Dataset, data: Path
) -> None:
    """The same bytes as if every step were recorded anew, where fewer Gaussians need no new buffers, and images of
    several sizes take turns."""
    views = tuple(smaller(view) if number % 2 else view for number, view in enumerate(dataset.train))
    dataset = dataclasses.replace(dataset, train=views)
    config = configure(data__path=str(data), density__start="1000", density__stop="1001", schedule__warm_up="2")
    states = []
    for anew in (False, True):
        trainer = started(config, dataset, device, "resident")
        for number in range(14):
            if number in (6, 10):
                rows = {name: row[:0] for name, row in trainer.scene.parameters.items()}
                keep = torch.arange(len(trainer.scene)) % 3 > 0
                trainer._density.statistics = trainer._density.statistics.of(keep)
                trainer._learners.optimizer.edit_rows(keep, rows)
            if anew:
                trainer._resident._passes._recordings.clear()
            trainer.step()
        states.append(trainer.state())
    assert [name for name in states[0] if not np.array_equal(states[0][name], states[1][name])] == []


def test_steps_in_flight_behind_an_overflow_are_taken_again(
    device: Device, dataset: Dataset, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bytes as with buffers that sufficed from the start; also where they shrink again."""
    monkeypatch.setattr(buffer_plan, "_WATCHED", 5)
    config = configure(data__path=str(data), schedule__steps="12")
    states = []
    for capacity in (None, 64):
        trainer = started(config, dataset, device, "resident")
        for number in range(12):
            if capacity is not None and number in (3, 8):
                trainer._resident.settle()
                plans = trainer._resident._passes.rasterizer.plans
                plans.now = dataclasses.replace(plans.now, capacity=capacity)
            trainer.step()
        states.append(trainer.state())
    assert [name for name in states[0] if not np.array_equal(states[0][name], states[1][name])] == []


def test_a_step_that_is_not_finite_is_skipped_and_named(device: Device, dataset: Dataset, data: Path) -> None:
    """With two steps in flight behind it: the same bytes as if none had been."""
    config = configure(data__path=str(data), schedule__steps="12", schedule__warm_up="2")
    states, told = [], []
    for waits in (False, True):
        trainer = started(config, dataset, device, "resident")
        spoil(trainer._resident._passes, at=7)
        results = []
        for result in trainer:
            results.append(result)
            if waits:
                trainer._resident.settle()
        states.append(trainer.state())
        told.append([result.skipped for result in results])
    for skipped in told:
        assert [each.step for each in skipped if each] == [7]
        assert "the loss term l1 is nan" in skipped[6].what
    assert [name for name in states[0] if not np.array_equal(states[0][name], states[1][name])] == []


def spoil(passes: ResidentPasses, at: int) -> None:
    """Draw one of the steps on a background that is not finite."""
    record = passes.record

    def spoiled(commands: Commands, task: Task, truth: DeviceArray, background: Tensor) -> Recorded:
        return record(commands, task, truth, background * math.nan if task.scheduled.step == at else background)

    passes.record = spoiled


def smaller(view: View) -> View:
    """The upper left part of a view."""
    camera = dataclasses.replace(view.camera, width=view.camera.width - 5, height=view.camera.height - 9)
    return dataclasses.replace(view, camera=camera, load=lambda: view.load()[: camera.height, : camera.width].copy())


def steps(trainer: Trainer, count: int) -> None:
    for _ in range(count):
        trainer.step()


def no_memory(rasterizer: Rasterizer, patched: pytest.MonkeyPatch) -> None:
    """The next steps' intersections are too many, and buffers cannot grow."""
    rasterizer.plans.now = dataclasses.replace(rasterizer.plans.now, capacity=64)
    grow = rasterizer.grow_on_overflow

    def fail(drawing: Drawing, *needed: Any) -> bool:
        if drawing.plan.capacity == 64:
            raise DeviceMemoryError("too many intersections")
        return grow(drawing, *needed)

    patched.setattr(rasterizer, "grow_on_overflow", fail)


def test_what_only_torch_computes_is_refused_by_name(device: Device, dataset: Dataset) -> None:
    with pytest.raises(InputError, match="hexplane"):
        started(configure("hexplane"), dataset, device, "resident")
