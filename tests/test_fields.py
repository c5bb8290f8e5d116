"""The fields behind one interface: what each adds, what its ablations take away, and the smoothness losses."""

from dataclasses import replace

import pytest
import torch
from helpers.decoder_reference import decode_reference
from helpers.encoder_reference import encode_reference
from helpers.fields import COUNT, DYNAMICS, NEARBY, OURS, POINTS, ROWS, grid_field, made, parts, stirred

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig, FieldKind
from lapgs_wgpu.motion.fields.deformation import Deformation
from lapgs_wgpu.motion.fields.hexplane_field import HexPlaneField
from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion, TimeMotion
from lapgs_wgpu.motion.fields.mlp_field import MlpField, octaves
from lapgs_wgpu.motion.fields.parameter_shapes import PLANES
from lapgs_wgpu.motion.scene import make_field

KINDS: tuple[FieldKind, ...] = ("mlp", "hexplane", "grid4d", "laplacian")


# All of them


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_changes_at_first(device: Device, kind: FieldKind) -> None:
    move = made(device, replace(OURS, kind=kind, appearance="color+opacity"))(POINTS, 0.7, DYNAMICS)
    if move.rotation is not None:
        assert torch.equal(move.rotation, torch.tensor([1.0, 0, 0, 0]).expand(COUNT, 4))
    changes = [part for part in move[1:] if part is not None]
    assert len(changes) == (5 if kind == "laplacian" else 3)
    assert not any(part.any() for part in changes)


@pytest.mark.parametrize("kind", KINDS)
def test_time_and_place_matter_and_all_weights_learn(device: Device, kind: FieldKind) -> None:
    field = stirred(made(device, replace(OURS, kind=kind)))
    points = POINTS.clone().requires_grad_()
    early, late = field(points, 0.1, DYNAMICS), field(points, 0.9, DYNAMICS)
    assert not torch.allclose(early.translation, late.translation)
    assert not torch.allclose(early.translation[0], early.translation[1])
    again = field(points, 0.1, DYNAMICS)
    assert all(torch.equal(a, b) for a, b in zip(parts(early), parts(again), strict=True))
    sum(part.square().sum() for part in parts(early)).backward()
    assert points.grad is None  # the encoder sees sg[mean]
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name


@pytest.mark.parametrize("kind", KINDS)
def test_lengths_are_learnt_in_units(device: Device, kind: FieldKind) -> None:
    one, half = (
        stirred(made(device, replace(OURS, kind=kind, unit=unit)))(POINTS, 0.3, DYNAMICS) for unit in (1.0, 0.5)
    )
    for name in Deformation._fields:
        expected, found = getattr(one, name), getattr(half, name)
        if expected is not None:
            factor = 0.5 if name in ("translation", "d_scales") else 1.0
            torch.testing.assert_close(found, factor * expected, msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_no_points(device: Device, kind: FieldKind) -> None:
    move = made(device, replace(OURS, kind=kind))(torch.zeros(0, 3), 0.5, torch.zeros(0, 5))
    assert {len(part) for part in parts(move)} == {0}


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_decides_and_nothing_else(device: Device, kind: FieldKind) -> None:
    config = replace(OURS, kind=kind)
    states = []
    for noise, seed in ((5, 3), (6, 3), (7, 4)):
        torch.manual_seed(noise)
        field = make_field(config, device, seed)
        assert field is not None
        states.append(field.state_dict())
    first, again, other = states
    assert all(torch.equal(again[name], value) for name, value in first.items())
    assert any(not torch.equal(other[name], value) for name, value in first.items())


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_is_in_one_group_but_the_frequencies(device: Device, kind: FieldKind) -> None:
    field = made(device, replace(OURS, kind=kind))
    grouped = [id(p) for group in field.parameter_groups().values() for p in group]
    expected = [id(p) for name, p in field.named_parameters() if name != "motion.frequencies"]
    assert sorted(grouped) == sorted(expected)


# The paper's field over Grid4D's


WRITTEN_OUT = {
    "grid4d": {"kind": "grid4d"},
    "laplacian": {},
    "opacity": {"appearance": "color+opacity"},
    "one hidden layer": {"depth": 1, "appearance": "color+opacity"},
    "two hidden layers": {"depth": 2, "kind": "grid4d"},
}


@pytest.mark.parametrize("name", WRITTEN_OUT)
def test_the_decoder_written_out(device: Device, name: str) -> None:
    """Equations 6, 8 and 9, from the tables to the heads."""
    field = grid_field(device, replace(OURS, unit=0.5, **WRITTEN_OUT[name]))
    for t in (0.0, 0.3, 1.0):
        heads, look = decode_reference(field, POINTS, DYNAMICS, t)
        turn = heads[:, :4] + heads.new_tensor([1.0, 0, 0, 0])
        expected = [turn / turn.norm(dim=1, keepdim=True), heads[:, 4:7], heads[:, 7:11], heads[:, 11:]]
        if look.shape[1]:
            expected.append(look[:, :3])
        expected += look[:, 3:].unbind(1)
        for found, wanted in zip(parts(field(POINTS, t, DYNAMICS)), expected, strict=True):
            torch.testing.assert_close(found.double(), wanted, rtol=1e-4, atol=1e-4)


def test_static_scenes_have_no_field(device: Device) -> None:
    assert make_field(FieldConfig(kind="static"), device) is None


def test_time_fills_a_share_of_its_axis() -> None:
    assert [OURS.grid_time(t) for t in (0.0, 0.5, 1.0)] == pytest.approx([0.05, 0.5, 0.95])


def test_ablations_of_the_field(device: Device) -> None:
    full = grid_field(device)
    assert isinstance(full.motion, LaplacianMotion)
    assert isinstance(grid_field(device, replace(OURS, motion="mlp")).motion, TimeMotion)
    assert grid_field(device, replace(OURS, appearance="none"))(POINTS, 0.3, DYNAMICS).d_dc is None
    still = grid_field(device, replace(OURS, temporal_hash=False))
    assert len(still.grids) == 1
    moves = [still(POINTS, t, DYNAMICS) for t in (0.1, 0.4)]
    assert torch.equal(*[move.d_dc for move in moves])  # A_h does not know the time any more
    assert not torch.allclose(*[move.translation for move in moves])  # L(t) does
    bare = grid_field(device, replace(OURS, temporal_hash=False, dynamics=0))
    assert bare(POINTS, 0.3).translation.isfinite().all()
    assert replace(OURS, dynamics=0).dynamics_size == replace(OURS, kind="grid4d").dynamics_size == 0


def test_dynamics_get_a_gradient(device: Device) -> None:
    d = DYNAMICS.clone().requires_grad_()
    grid_field(device)(POINTS, 0.3, d).translation.sum().backward()
    assert d.grad is not None
    assert d.grad.any(dim=1).all()


# Smoothness


def test_smoothness_of_grids_written_out(device: Device) -> None:
    field = grid_field(device)
    found = field(POINTS, 0.3, DYNAMICS, NEARBY).smoothness
    near = POINTS[ROWS] + NEARBY.offsets
    squares = []
    for grid in field.grids:
        here = encode_reference(grid, grid.table.double(), POINTS[ROWS], field.config.grid_time(0.3), OURS.bound)
        there = encode_reference(grid, grid.table.double(), near, field.config.grid_time(0.32), OURS.bound)
        squares.append(float((there - here).square().sum(dim=1).mean().detach()))
    assert found is not None
    assert found.item() == pytest.approx(0.7 * squares[0] + 0.2 * sum(squares[1:]), rel=1e-4)
    without = field(POINTS, 0.3, DYNAMICS)
    assert without.smoothness is None
    assert torch.equal(without.translation, field(POINTS, 0.3, DYNAMICS, NEARBY).translation)
    found.backward()
    gradients = [grid.table.grad for grid in field.grids]
    # A place that is asked for twice: its gradient by the reference.
    tables = [grid.table.detach().clone().requires_grad_() for grid in field.grids]
    total = torch.zeros(())
    for number, (grid, table) in enumerate(zip(field.grids, tables, strict=True)):
        here = encode_reference(grid, table, POINTS[ROWS], field.config.grid_time(0.3), OURS.bound)
        there = encode_reference(grid, table, near, field.config.grid_time(0.32), OURS.bound)
        total = total + (0.7 if number == 0 else 0.2) * (there - here).square().sum(dim=1).mean()
    total.backward()
    for ours, table in zip(gradients, tables, strict=True):
        assert ours is not None
        assert table.grad is not None
        torch.testing.assert_close(ours, table.grad, rtol=1e-3, atol=1e-5)


def test_smoothness_of_planes_sees_bends_only(device: Device) -> None:
    field = made(device, replace(OURS, kind="hexplane"))
    assert isinstance(field, HexPlaneField)
    with torch.no_grad():
        for number, plane in enumerate(field.planes):
            slope = torch.linspace(0, 1, plane.shape[2])[:, None].expand(plane.shape[2:])
            plane.copy_(torch.ones_like(plane) if PLANES[number % 6][1] == 3 else slope.expand_as(plane))
    straight = field(POINTS, 0.3, None, NEARBY).smoothness
    assert straight is not None
    assert straight.item() < 1e-12
    with torch.no_grad():
        field.planes[3][0, 0, 4, 2] += 0.5  # x, t
    bent = field(POINTS, 0.3, None, NEARBY).smoothness
    assert bent is not None
    values = 4 * 8 * 6
    squares = 0.5**2 * (1 + 4 + 1) / (4 * 6 * 6)  # second differences 0.5, -1, 0.5 among 4 features x 6 x 6
    assert bent.item() == pytest.approx(1e-2 * squares + 1e-4 * 0.5 / values, rel=1e-4)


# The baselines


def test_octaves() -> None:
    found = octaves(torch.tensor([[0.25]]), 2)
    assert found.tolist()[0] == pytest.approx([0.25, 0.5**0.5, 0.5**0.5, 1.0, 0.0], abs=1e-6)


def test_the_mlp_sees_its_inputs_again_in_the_middle(device: Device) -> None:
    field = made(device, replace(OURS, kind="mlp"))
    assert isinstance(field, MlpField)
    assert [layer.in_features for layer in field.layers] == [93, 16, 16, 16, 16 + 93, 16, 16, 16]  # type: ignore[union-attr]
    assert field(POINTS, 0.3).rotation is None


def test_planes_are_read_where_they_say(device: Device) -> None:
    """One plane that holds its second coordinate, all others one: the feature is that coordinate."""
    field = made(device, replace(OURS, kind="hexplane"))
    assert isinstance(field, HexPlaneField)
    for number, (a, b) in enumerate(PLANES):
        with torch.no_grad():
            for other in range(6):
                field.planes[other].fill_(1.0)
            plane = field.planes[number]
            along_b = torch.linspace(-1, 1, plane.shape[2])[:, None]
            along_a = torch.linspace(-1, 1, plane.shape[3])[None, :]
            plane.copy_((along_b + 10 * along_a).expand_as(plane))
        unit = torch.rand(9, 4, generator=torch.Generator().manual_seed(number)) * 2 - 1
        found = field._features(unit, 0)
        torch.testing.assert_close(found[:, 0], unit[:, b] + 10 * unit[:, a], rtol=1e-4, atol=1e-4)
