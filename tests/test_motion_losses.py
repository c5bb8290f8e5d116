"""The acceleration loss: where it looks, its value and gradients, and what a training makes of it."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.training import configure
from torch import Tensor, nn

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, TimeSamples
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import AccelerationConfig
from lapgs_wgpu.train.motion_losses import WOBBLE, acceleration_loss, compared_counts, even_times
from lapgs_wgpu.train.step_result import Scheduled
from lapgs_wgpu.train.trainer import Trainer

CONFIG = AccelerationConfig(weight=1.0, share=0.5)
COUNT = 9


class Curve(nn.Module):
    """Means move by speed t + bend t^2, and scales grow by a tenth of that."""

    def __init__(self) -> None:
        super().__init__()
        self.speed = nn.Parameter(torch.tensor([0.3, -0.2, 0.1]))
        self.bend = nn.Parameter(torch.tensor([0.0, 0.4, 0.0]))

    def forward(self, means: Tensor, t: float) -> Deformation:
        shift = (self.speed * t + self.bend * t * t).expand(len(means), 3)
        return Deformation(translation=shift, d_scales=0.1 * shift)


def scene_of(device: Device, field: FieldConfig, own: nn.Module | None = None) -> Scene4D:
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (COUNT, 3))
    colors, scales = random.random((COUNT, 3)), np.full(COUNT, 0.5)
    return Scene4D.from_points(points, colors, scales, field, device=device, own_field=own)


def test_value_is_the_robust_distance_from_the_chord(device: Device) -> None:
    """Of a parabola: |bend| (t - before) (after - t), of means and, a tenth, of scales."""
    curve = Curve()
    scene = scene_of(device, FieldConfig(kind="own"), curve)
    samples = TimeSamples(torch.tensor([0, 3, 3]), (0.33, 0.37))
    loss = acceleration_loss(scene.deformed(0.35, time_samples=samples), 0.35, samples)
    loss.backward()
    bend = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    lengths = bend * 0.02 * 0.02 * torch.tensor([1.0, 0.1], dtype=torch.float64)
    expected = (WOBBLE * lengths / (lengths + WOBBLE)).sum()
    expected.backward()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-3)
    assert curve.bend.grad is not None
    assert curve.speed.grad is not None
    assert bend.grad is not None
    torch.testing.assert_close(curve.bend.grad, torch.tensor([0.0, bend.grad.item(), 0.0]), rtol=2e-3, atol=1e-6)
    torch.testing.assert_close(curve.speed.grad, torch.zeros(3), rtol=0, atol=1e-6)


def test_chosen_rows_move_as_all_do(device: Device) -> None:
    scene = scene_of(device, configure().field)
    assert scene.field is not None
    for parameter in scene.field.parameters():
        nn.init.normal_(parameter, std=0.1, generator=torch.Generator().manual_seed(1))
    rows = torch.tensor([7, 2, 2, 5])
    found = scene.deformed(0.7, time_samples=TimeSamples(rows, (0.4, 0.5)))
    for t, (means, scales) in zip((0.4, 0.5), found.at_times, strict=True):
        every = scene.at(t)
        torch.testing.assert_close(means, every.means[rows], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(scales, every.scales[rows], rtol=1e-5, atol=1e-6)
    assert not torch.allclose(found.at_times[0][0], found.at_times[1][0])


def test_times_lie_half_to_whole_the_reach_apart() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(50):
        before, after = even_times(0.5, 101, generator)
        assert 0.01 <= 0.5 - before <= 0.02
        assert after - 0.5 == pytest.approx(0.5 - before)
    assert even_times(0.995, 101, generator)[1] == 1


@pytest.mark.parametrize(
    ("config", "count", "times"), [(AccelerationConfig(), 40, 101), (CONFIG, 1, 101), (CONFIG, 40, 1), (CONFIG, 40, 2)]
)
def test_nowhere_to_look(config: AccelerationConfig, count: int, times: int) -> None:
    whole = dataclasses.replace(configure(), acceleration=config)
    assert compared_counts(whole, Scheduled(1, True, 1.0, seen=True), count, times, fitted=False)[1] == 0


def test_it_rests_where_discovery_explains_what_moves(dataset: Dataset, device: Device) -> None:
    with Trainer(
        configure(acceleration__weight="1", acceleration__interval="1", schedule__warm_up="0"), dataset, device
    ) as training:
        assert training.step().terms["acceleration"] > 0
        training._learners.set_field_fitted(1.0)
        assert "acceleration" not in training.step().terms


def test_it_rests_between_and_counts_the_more(dataset: Dataset, device: Device) -> None:
    """Every third step, then with three times the weight: here from the same state."""
    terms = []
    for interval, done in (("3", 0), ("3", 1), ("3", 2), ("1", 2)):
        given = {"acceleration__weight": "1", "acceleration__interval": interval, "acceleration__share": "1"}
        with Trainer(configure(schedule__warm_up="0", **given), dataset, device) as training:
            for parameter in training.scene.field.parameters():
                nn.init.normal_(parameter, std=0.1, generator=torch.Generator().manual_seed(1))
            training.done = done
            terms.append(training.step().terms.get("acceleration"))
    assert terms[:2] == [None, None]
    assert terms[2] == pytest.approx(3 * terms[3])
    assert terms[3] > 0
