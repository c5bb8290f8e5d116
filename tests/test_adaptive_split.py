"""The adaptive split: neighbours, differences in shape and dynamics, and which candidates they let through."""

import dataclasses
import math
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from lapgs_wgpu.train import densify as module
from lapgs_wgpu.train.densify import DensityState, Statistics, adaptive_split, divergence, nearest, probabilities
from lapgs_wgpu.train.presets import load_config

CONFIG = dataclasses.replace(load_config("dnerf").density, split="adaptive")
EXTENT = 1.0


def make_rows(count: int, seed: int = 0) -> dict[str, Tensor]:
    """Gaussians of many shapes, all of them larger than SPLIT_SIZE."""
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(count, 3, generator=generator),
        "log_scales": torch.randn(count, 3, generator=generator).abs() - 3,
        "quats": torch.randn(count, 4, generator=generator),
        "opacity_logits": torch.zeros(count),
        "dynamics": torch.randn(count, 16, generator=generator),
    }


def equals(count: int) -> dict[str, Tensor]:
    """Gaussians that are equal but for their places, on a line; nobody is an outlier."""
    rows = {name: row[:1].repeat(count, *[1] * (row.ndim - 1)) for name, row in make_rows(1).items()}
    return rows | {"means": torch.arange(float(count))[:, None] * torch.tensor([1.0, 0.0, 0.0])}


def everyone(rows: Mapping[str, Tensor]) -> Tensor:
    return torch.ones(len(rows["means"]), dtype=torch.bool)


# Neighbours


def test_nearest_breaks_ties_by_number_and_leaves_itself_out() -> None:
    means = torch.zeros(40, 3)
    means[20:] = 5.0
    means[:4, 0] = torch.tensor([1.0, 0.0, 1.0, -1.0])
    assert nearest(means[:4], torch.tensor([1]), 3).tolist() == [[0, 2, 3]]
    # Twenty at one place: whichever are found, itself never is.
    found = nearest(means, torch.arange(20, 40), 10)
    assert found.shape == (20, 10)
    assert (found >= 20).all()
    assert not (found == torch.arange(20, 40)[:, None]).any()
    assert (found.diff(dim=1) > 0).all()


@pytest.mark.parametrize("count", [1, 2, 5, 10])
def test_fewer_gaussians_than_neighbours(count: int) -> None:
    rows = make_rows(count)
    found = nearest(rows["means"], torch.arange(count), 10)
    assert found.shape == (count, count - 1)
    assert all(sorted([i, *row]) == list(range(count)) for i, row in enumerate(found.tolist()))
    scores = module.split_scores(rows, torch.arange(count))
    assert scores.isfinite().all()
    assert count > 1 or scores.tolist() == [0.0]
    assert adaptive_split(rows, everyone(rows)).any(), "the highest score reaches every quantile"


# Shapes


def test_shape_difference_by_hand() -> None:
    own, other = torch.diag(torch.tensor([4.0, 0.0, 3.0])), torch.diag(torch.tensor([0.0, 0.0, 3.0]))
    two = torch.stack([other, own])[None]
    # |S - S'| = 4, |S| = 5, |S'| = 3; and none from the neighbour that is equal.
    assert module.shape_difference(own[None], two).tolist() == pytest.approx([(4 / 8 + 0) / 2])


# Dynamics


def test_divergence_is_zero_for_uniform_and_one_for_one_hot() -> None:
    for count in (2, 10):
        assert divergence(torch.full((1, count), 1 / count)).item() == pytest.approx(0, abs=1e-7)
        assert divergence(torch.eye(count)).tolist() == pytest.approx([1.0] * count)
    assert divergence(torch.ones(1, 1)).item() == 0
    # (3/4) ln (3/4 : 1/2) + (1/4) ln (1/4 : 1/2), over ln 2
    expected = (0.75 * math.log(1.5) + 0.25 * math.log(0.5)) / math.log(2)
    assert divergence(torch.tensor([[0.75, 0.25]])).item() == pytest.approx(expected)


def test_dynamics_count_where_shapes_are_equal() -> None:
    rows = equals(12)
    of = torch.tensor([0, 11])
    assert module.split_scores(rows, of, 3).tolist() == pytest.approx([0, 0], abs=1e-12)
    rows["dynamics"][2, 0] += 1.0  # a neighbour of the first alone
    high, low = module.split_scores(rows, of, 3).tolist()
    expected = divergence(probabilities(torch.tensor([[0.0, 1.0, 0.0]]))).item()
    assert expected > 0.8
    assert high == pytest.approx(0.5 * expected, rel=1e-5)
    assert low == pytest.approx(0, abs=1e-12)


def test_without_dynamics_the_distances_between_means_count() -> None:
    rows = equals(12)
    del rows["dynamics"]
    # Neighbours of the first are 1, 2 and 3 away; of one in the middle 1, 1 and 2.
    first, middle = module.split_scores(rows, torch.tensor([0, 5]), 3).tolist()
    assert first == pytest.approx(0.5 * divergence(probabilities(torch.tensor([[1.0, 2.0, 3.0]]))).item(), rel=1e-5)
    assert middle == pytest.approx(0.5 * divergence(probabilities(torch.tensor([[1.0, 1.0, 2.0]]))).item(), rel=1e-5)
    assert adaptive_split(rows, everyone(rows)).any()


# Which candidates are split


@pytest.mark.parametrize(("quantile", "count"), [(0.0, 5), (0.3, 3), (0.5, 3), (0.76, 1), (1.0, 1)])
def test_scores_from_the_quantile_on_are_split(monkeypatch: pytest.MonkeyPatch, quantile: float, count: int) -> None:
    rows = equals(8)
    candidates = torch.tensor([True, False, True, True, False, True, True, False])
    scores = torch.tensor([0.3, 0.1, 0.5, 0.2, 0.4], dtype=torch.float64)
    monkeypatch.setattr(module, "split_scores", lambda rows, of, *_: scores)
    monkeypatch.setattr(module, "SPLIT_QUANTILE", quantile)
    split = adaptive_split(rows, candidates)
    highest_first = [3, 6, 0, 5, 2]
    assert split.nonzero()[:, 0].tolist() == sorted(highest_first[:count])


def test_outliers_are_split_whatever_their_score() -> None:
    rows = make_rows(100)
    rows["dynamics"] *= 0
    candidates = torch.arange(100) % 2 == 0
    before = adaptive_split(rows, candidates)
    lowest = int(module.split_scores(rows, torch.arange(0, 100, 2)).argmin()) * 2
    assert not before[lowest]
    rows["dynamics"][[lowest, lowest + 1]] = 100.0
    after = adaptive_split(rows, candidates)
    assert after[lowest]
    assert not after[lowest + 1], "an outlier that is no candidate"
    without = adaptive_split({name: row for name, row in rows.items() if name != "dynamics"}, candidates)
    assert not without[lowest]


# In density control


def test_quantile_zero_is_the_plain_split(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SPLIT_QUANTILE", 0.0)
    rows, statistics = make_rows(30), Statistics.zeros(30)
    statistics.gradients, statistics.views = torch.ones(30), torch.ones(30)
    changes = [
        module.published_rule(DensityState(1, rows, statistics, config, EXTENT, torch.Generator().manual_seed(0)))
        for config in (dataclasses.replace(CONFIG, split="plain"), CONFIG)
    ]
    assert not changes[0].keep.any()
    assert len(changes[0].added["means"]) == 60
    assert all(torch.equal(changes[0].added[name], changes[1].added[name]) for name in rows)
