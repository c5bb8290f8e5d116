"""The deformation field: still at first, then trainable in all its parts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.encoder_reference import encode_reference
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig
from lapgs_wgpu.motion.scene import make_field

SMALL = FieldConfig(
    kind="grid4d",
    bound=1.5,
    unit=0.5,
    static=HashConfig(3, (4, 4, 4), (16, 16, 16), table_log2=9),
    temporal=HashConfig(4, (4, 4, 4), (12, 12, 8)),
    width=16,
    depth=1,
)
POINTS = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) * 2.4 - 1.2


def moving_field(device: Device, config: FieldConfig = SMALL) -> GridField:
    """With weights and tables as training might leave them."""
    field = GridField(config, device, seed=0)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.normal_(0, 0.3, generator=generator)
    return field


def geometry(move: Deformation) -> list[Tensor]:
    assert move.rotation is not None
    return [move.rotation, move.translation, move.d_quats, move.d_scales]


def test_nothing_moves_at_first(device: Device) -> None:
    field = GridField(SMALL, device, seed=0)
    for t in (0.0, 0.5, 1.0):
        move = field(POINTS, t)
        assert torch.equal(move.rotation, torch.tensor([1.0, 0, 0, 0]).expand(40, 4))
        assert not move.translation.any()
        assert not move.d_quats.any()
        assert not move.d_scales.any()


def test_no_points(device: Device) -> None:
    move = moving_field(device)(torch.zeros(0, 3), 0.5)
    assert [tuple(part.shape) for part in geometry(move)] == [(0, 4), (0, 3), (0, 4), (0, 3)]


def by_hand(field: GridField, points: Tensor, t: float) -> list[Tensor]:
    """Grid4D's decoder written out: temporal features gated by spatial ones, hidden layers, heads."""
    time = (((2 * t - 1) * field.config.time_scale) + 1) / 2
    features = [
        encode_reference(grid, grid.table.double(), points, time, field.config.bound).float() for grid in field.grids
    ]
    weights = dict(field.named_parameters())

    def layer(name: str, x: Tensor) -> Tensor:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    gate = 2 / (1 + torch.exp(-layer("spatial", features[0]))) - 1
    hidden = torch.relu(layer("temporal", torch.cat(features[1:], dim=1))) * gate
    for i in range(field.config.depth):
        hidden = torch.relu(layer(f"hidden.{2 * i}", hidden))
    heads = layer("heads", hidden)
    turn = heads[:, :4] + torch.tensor([1.0, 0, 0, 0])
    return [turn / turn.norm(dim=1, keepdim=True), 0.5 * heads[:, 4:7], heads[:, 7:11], 0.5 * heads[:, 11:]]


@pytest.mark.parametrize("depth", [0, 1, 2])
@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_the_decoder_written_out(device: Device, depth: int, t: float) -> None:
    field = moving_field(device, replace(SMALL, depth=depth))
    found = geometry(field(POINTS, t))
    for part, expected in zip(found, by_hand(field, POINTS, t), strict=True):
        torch.testing.assert_close(part, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found[0].norm(dim=1), torch.ones(40))


def test_time_fills_a_share_of_its_axis(device: Device) -> None:
    field = GridField(SMALL, device, seed=0)
    assert [field.config.grid_time(t) for t in (0.0, 0.5, 1.0)] == pytest.approx([0.05, 0.5, 0.95])


def test_motion_depends_on_time_and_place(device: Device) -> None:
    field = moving_field(device)
    early, late = field(POINTS, 0.1).translation, field(POINTS, 0.9).translation
    assert not torch.allclose(early, late)
    assert not torch.allclose(early[0], early[1])
    assert torch.equal(field(POINTS, 0.1).translation, early)


def test_every_parameter_is_in_one_group(device: Device) -> None:
    field = GridField(SMALL, device, seed=0)
    groups = field.parameter_groups()
    assert set(groups) == {"hash", "mlp"}
    assert [id(p) for p in groups["hash"]] == [id(grid.table) for grid in field.grids]
    grouped = [id(p) for group in groups.values() for p in group]
    assert sorted(grouped) == sorted(id(p) for p in field.parameters())
    assert len(set(grouped)) == len(grouped)


def test_gradients_reach_every_parameter(device: Device) -> None:
    field = moving_field(device)
    points = POINTS.clone().requires_grad_()
    torch.cat(geometry(field(points, 0.3)), dim=1).square().sum().backward()
    assert points.grad is None
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all()
        assert parameter.grad.any(), name


def test_at_the_start_only_the_heads_learn(device: Device) -> None:
    """Zero heads hide everything before them; after one step of theirs all else has gradients, too."""
    field = GridField(SMALL, device, seed=0)
    optimizer = torch.optim.SGD(field.parameters(), lr=0.1)
    target = torch.ones(40, 3)
    for expected in (False, True):
        optimizer.zero_grad(set_to_none=False)
        (field(POINTS, 0.3).translation - target).square().sum().backward()
        assert field.heads.weight.grad is not None
        assert field.heads.bias.grad is not None
        assert field.heads.bias.grad.any()
        assert all(bool(grid.table.grad.any()) == expected for grid in field.grids if grid.table.grad is not None)
        optimizer.step()


def test_the_gradient_is_the_derivative(device: Device) -> None:
    """Through the decoder and the kernels, against the tables moved a little along the gradient."""
    field = moving_field(device)

    def loss() -> Tensor:
        return torch.cat(geometry(field(POINTS, 0.3)), dim=1).sin().sum()

    loss().backward()
    tables = [grid.table for grid in field.grids]
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad.clone() for t in tables]
    slope = sum(float(g.double().square().sum()) for g in gradients)
    values = []
    for move in (1e-3, -1e-3):
        with torch.no_grad():
            for table, gradient in zip(tables, gradients, strict=True):
                table += move * gradient / slope**0.5
            values.append(float(loss().double()))
            for table, gradient in zip(tables, gradients, strict=True):
                table -= move * gradient / slope**0.5
    assert (values[0] - values[1]) / 2e-3 == pytest.approx(slope**0.5, rel=0.02)


def test_the_seed_decides_and_nothing_else(device: Device) -> None:
    torch.manual_seed(5)
    first = GridField(SMALL, device, seed=3).state_dict()
    torch.manual_seed(6)
    again, other = (GridField(SMALL, device, seed=seed).state_dict() for seed in (3, 4))
    assert all(torch.equal(again[name], value) for name, value in first.items())
    assert any(not torch.equal(other[name], value) for name, value in first.items())


def test_static_scenes_have_no_field(device: Device) -> None:
    assert make_field(FieldConfig(kind="static"), device) is None
    assert isinstance(make_field(SMALL, device), GridField)
