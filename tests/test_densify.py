"""Density control: statistics in the right units, who is cloned, split and removed, and what children inherit."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.config import DensityConfig
from lapgs_wgpu.train.densify import Change, DensityState, Statistics, published_rule, reset_opacities, split_rows
from lapgs_wgpu.train.presets import load_config

CONFIG = load_config("dnerf").density
EXTENT = 4.0
SMALL, LARGE = 0.02, 0.2  # standard deviations on either side of SPLIT_SIZE times the extent


def make_rows(scales: list[float], opacities: list[float] | None = None) -> dict[str, Tensor]:
    n = len(scales)
    opacity = torch.tensor(opacities or [0.5] * n)
    generator = torch.Generator().manual_seed(n)
    return {
        "means": torch.arange(3.0 * n).reshape(n, 3),
        "log_scales": torch.tensor(scales).log()[:, None] - torch.tensor([0.0, 0.5, 1.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "opacity_logits": opacity.logit(),
        "dynamics": torch.arange(n * 16.0).reshape(n, 16),  # which the plain split does not look at
    }


def make_statistics(gradients: list[float]) -> Statistics:
    statistics = Statistics.zeros(len(gradients))
    statistics.gradients = torch.tensor(gradients) * 5
    statistics.views = torch.full((len(gradients),), 5.0)
    return statistics


def change(
    rows: dict[str, Tensor], statistics: Statistics, *, bound_sizes: bool = False, config: DensityConfig = CONFIG
) -> Change:
    step = config.reset_interval + int(bound_sizes)
    return published_rule(DensityState(step, rows, statistics, config, EXTENT, torch.Generator().manual_seed(0)))


def test_statistics_are_means_over_visible_views_in_normalised_device_coordinates() -> None:
    camera = Camera(np.eye(3), np.eye(4), 200, 100)
    statistics = Statistics.zeros(3)
    statistics.add(torch.tensor([4, 0, 0]), torch.tensor([[0.03, 0.08], [9.0, 9.0], [0.0, 0.0]]), camera)
    statistics.add(torch.tensor([2, 7, 0]), torch.tensor([[0.0, 0.0], [0.01, 0.0], [0.0, 0.0]]), camera)
    # Pixel gradients times half the image's width and height; what is not visible does not count.
    assert statistics.mean_gradients.tolist() == pytest.approx([math.hypot(3, 4) / 2, 1.0, 0.0])
    assert statistics.views.tolist() == [2, 1, 0]


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    rows = make_rows([SMALL, SMALL, LARGE, LARGE])
    result = change(rows, make_statistics([1e-3, 1e-5, 1e-3, 1e-5]))
    assert len(result.added["means"]) == 3
    assert result.keep.tolist() == [True, True, False, True]
    clone = {name: row[0] for name, row in result.added.items()}
    assert all(torch.equal(clone[name], rows[name][0]) for name in rows)
    children = {name: row[1:] for name, row in result.added.items()}
    assert len(children["means"]) == 2
    assert torch.allclose(children["log_scales"].exp(), rows["log_scales"][2].exp() / 1.6)
    for name in ("quats", "opacity_logits", "dynamics"):
        assert torch.equal(children[name], rows[name][[2, 2]])
    assert not torch.equal(children["means"][0], children["means"][1])


def test_children_are_distributed_like_their_parent() -> None:
    n = 4000
    quat = torch.tensor([0.8, 0.3, -0.4, 0.33])
    scales = torch.tensor([0.5, 0.2, 0.05])
    parents = {
        "means": torch.tensor([1.0, 2.0, 3.0]).repeat(n, 1),
        "quats": 3 * quat.repeat(n, 1),
        "log_scales": scales.log().repeat(n, 1),
    }
    children = split_rows(parents, torch.Generator().manual_seed(5))["means"]
    w, x, y, z = (quat / quat.norm()).tolist()
    R = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    expected = R @ torch.diag(scales**2) @ R.T
    assert len(children) == 2 * n
    assert torch.allclose(children.mean(0), parents["means"][0], atol=0.03)
    assert torch.allclose(torch.cov(children.T), expected, atol=0.012)


def test_faint_ones_go_at_every_change_also_before_any_reset() -> None:
    rows = make_rows([SMALL] * 3, [0.5, 0.004, 0.006])
    result = change(rows, make_statistics([0.0, 0.0, 0.0]))
    assert result.keep.tolist() == [True, False, True]


def test_clones_of_faint_ones_go_with_them() -> None:
    result = change(make_rows([SMALL, LARGE], [0.004, 0.004]), make_statistics([1.0, 1.0]))
    assert not result.keep.any()
    assert len(result.added["means"]) == 0


def test_sizes_are_bounded_from_the_first_reset_on() -> None:
    rows, seen = make_rows([SMALL, 0.5]), make_statistics([0.0] * 2)
    assert change(rows, seen).keep.all()
    assert change(rows, seen, bound_sizes=True).keep.tolist() == [True, False]
    unbounded = dataclasses.replace(CONFIG, max_world_size=0)
    assert change(rows, seen, bound_sizes=True, config=unbounded).keep.all()


def test_reset_lowers_only() -> None:
    logits = torch.tensor([0.9, 0.009, 0.01]).logit()
    assert reset_opacities(logits).sigmoid().tolist() == pytest.approx([0.01, 0.009, 0.01], rel=1e-5)


def test_schedule() -> None:
    assert [step for step in range(1, 801) if CONFIG.changes_at(step)] == [600, 700, 800]
    assert CONFIG.changes_at(14_900)
    assert not CONFIG.changes_at(15_000)
    assert [step for step in range(1, 20_000) if CONFIG.resets_at(step)] == [3000, 6000, 9000, 12_000]
    for least, steps in ((0.5, [1000, 1500]), (0.0, [])):  # not after the last step, nor without a threshold
        pruning = dataclasses.replace(CONFIG, min_contribution=least, contribution_interval=500)
        assert [step for step in range(1, 2001) if pruning.prunes_at(step, 2000)] == steps


def test_the_number_of_gaussians_is_bounded_and_the_largest_gradients_come_first() -> None:
    rows = make_rows([SMALL] * 8)
    statistics = make_statistics([CONFIG.gradient * (1.5 + i) for i in range(8)])
    config = dataclasses.replace(CONFIG, limit=10)
    result = change(rows, statistics, config=config)
    assert (int(result.keep.sum()), len(result.added["means"])) == (8, 2)
    assert torch.equal(result.added["means"], rows["means"][6:])
    assert len(change(rows, statistics, config=dataclasses.replace(CONFIG, limit=5)).added["means"]) == 0
    assert len(change(rows, statistics).added["means"]) == 8


@pytest.mark.parametrize("gradient", [0.0, 1.0])
@pytest.mark.parametrize("size", ["small", "large"])
def test_faint_gaussians_are_never_all_removed(size: str, gradient: float) -> None:
    opacities = [1e-4 * (1 + i) for i in range(8)]
    scales = {"small": SMALL, "large": LARGE}[size]
    result = change(make_rows([scales] * 8, opacities), make_statistics([gradient] * 8))
    assert result.keep.tolist() == [False] * 6 + [True] * 2
    assert not len(result.added["means"])
