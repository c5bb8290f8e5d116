"""What Gaussians contribute to images, and that those are pruned which nobody would miss."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.captures import cameras
from helpers.reference import rasterize_reference
from helpers.scene_files import moving_scene

from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train import density_control, trainer
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.density_control import contributions
from lapgs_wgpu.train.optimizer import Optimizer
from lapgs_wgpu.train.presets import load_config


def views(count: int) -> list[View]:
    return [
        View(f"train_{i:03d}", camera, i / max(count - 1, 1), "made up", lambda: np.zeros((48, 64, 3), np.uint8))
        for i, camera in enumerate(cameras(count, 64, 48))
    ]


@pytest.mark.parametrize("moving", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_contributions_are_the_largest_sums_of_blending_weights(device: Device, *, moving: bool) -> None:
    scene, shown = moving_scene(device), views(3)
    expected = torch.zeros(len(scene), dtype=torch.float64)
    for view in shown:
        gaussians = scene.at(view.time) if moving else scene.canonical()
        shape = [getattr(gaussians, name).detach().double() for name in ("means", "quats", "scales", "opacities")]
        for k in range(0, len(scene), 3):  # three Gaussians at a time, in a channel each
            colors = torch.zeros(len(scene), 3, dtype=torch.float64)
            colors[range(k, k + 3), range(3)] = 1.0
            image = rasterize_reference(*shape, colors, view.camera).image
            expected[k : k + 3] = torch.maximum(expected[k : k + 3], image.sum((0, 1)))
    assert expected.max() > 10
    assert (expected < 1).any()
    torch.testing.assert_close(contributions(scene, shown, moving=moving).double(), expected, rtol=1e-3, atol=1e-2)


def pruning_config(**changes: float) -> Config:
    config = load_config("demo", {"schedule.steps": "20", "antialiased": "false"})
    density = dataclasses.replace(config.density, start=2, stop=3, contribution_interval=4, **changes)
    return dataclasses.replace(config, density=density)


def test_pruning_keeps_the_largest_whatever_they_contribute(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    config, scene, shown = pruning_config(min_contribution=0.5), moving_scene(device), views(3)
    most = torch.linspace(0.0, 0.4, len(scene))[torch.randperm(len(scene), generator=torch.Generator().manual_seed(0))]
    monkeypatch.setattr(density_control, "contributions", lambda *_, **options: most)
    monkeypatch.setattr(density_control, "LEAST_KEPT", 3)
    optimizer = Optimizer(scene.parameters, {}, config.rates.schedules())
    data, camera = SimpleNamespace(train=shown), lambda view: view.camera
    of = SimpleNamespace(config=config, scene=scene, dataset=data, optimizer=optimizer, camera=camera)
    control = density_control.DensityControl(of, torch.Generator())
    kept = scene.parameters["means"].detach()[most >= most.sort().values[-3]]
    control.change(4, moving=True)
    assert torch.equal(scene.parameters["means"], kept)
    assert len(control.statistics.views) == 3


def test_training_prunes_what_hardly_shows(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(density_control, "LEAST_KEPT", 1)
    found: list[torch.Tensor] = []

    def noted(*arguments: Any, **options: Any) -> torch.Tensor:
        found.append(contributions(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(density_control, "contributions", noted)
    dataset = Dataset("made up", tuple(views(4)), ())

    def trained(least: float) -> list[int]:
        config = pruning_config(min_contribution=least)
        training = trainer.Trainer(config, dataset, device, scene=moving_scene(device, config.field))
        with training:
            return [len(training.scene) for _ in range(6) if training.step()]

    everything = trained(0.0)[-1]
    assert not found, "without a threshold nothing is looked at"
    counts = trained(0.5)
    assert len(found) == 1, "at step 4, after density.start"
    remaining = int((found[0] >= 0.5).sum())
    assert remaining < len(found[0]) == everything
    assert counts == [everything] * 3 + [remaining] * 3
