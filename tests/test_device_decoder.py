"""The decoder on the device: its passes against torch, and the whole of it against the field in torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.decoder_reference import gated
from helpers.fields import DYNAMICS, NEARBY, OURS, POINTS, grid_field, parts
from helpers.matrices import on_device, random, read
from helpers.scenes import relative
from torch import Tensor

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.native import Encoder
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.deformation import Nearby
from lapgs_wgpu.motion.fields.device_decoder import Decoder
from lapgs_wgpu.motion.fields.grid_field import GridField

pytestmark = pytest.mark.kernels

PLAIN = replace(OURS, depth=0, width=24)
FIELDS = {
    "laplacian": PLAIN,
    "grid4d": replace(PLAIN, kind="grid4d"),
    "opacity, too": replace(PLAIN, appearance="color+opacity"),
    "no appearance": replace(PLAIN, appearance="none"),
    "no dynamics": replace(PLAIN, dynamics=0),
    "no temporal grids": replace(PLAIN, temporal_hash=False),
}


def gate_reference(layers: Tensor, *, motion: bool) -> Tensor:
    """(N, layers, width) -> (N, features, width)."""
    features = gated(layers[:, -1], 2 * layers[:, 0])
    return torch.stack([features, torch.relu(layers[:, 1])], dim=1) if motion else features[:, None]


@pytest.mark.parametrize("motion", [False, True])
@pytest.mark.parametrize(("count", "width"), [(1, 1), (37, 20)])
def test_gate(device: Device, count: int, width: int, *, motion: bool) -> None:
    layers = 2 * random(count, 3 if motion else 2, width)
    layers[0, 0, 0], layers[-1, 0, -1] = 200.0, -200.0  # a quotient of exponentials would overflow
    options = {"MOTION": 1} if motion else {}
    forth, back = Kernel.get(device, "gate", **options), Kernel.get(device, "gate_bwd", **options)
    uniform = DeviceArray.upload(device, "gate", np.array([count, width], np.uint32))
    exact = layers.double().requires_grad_()
    expected = gate_reference(exact, motion=motion)
    d_features = random(*expected.shape, seed=1)
    (d_expected,) = torch.autograd.grad(expected, exact, d_features.double())
    of_layers, features = on_device(device, layers), on_device(device, torch.full(expected.shape, torch.nan))
    with Commands(device) as commands:
        groups = -(-count * width // 64)
        commands.dispatch(forth, groups, gate=uniform, layers=of_layers, features=features)
        d = on_device(device, d_features)
        commands.dispatch(back, groups, gate=uniform, d_features=d, layers=of_layers)
    torch.testing.assert_close(read(features).double(), expected.detach(), rtol=1e-5, atol=1e-6)
    # 1 - tanh^2 loses what little is left of a gate that is wide open.
    torch.testing.assert_close(read(of_layers).double(), d_expected, rtol=1e-5, atol=5e-6)


def test_smoothness(device: Device) -> None:
    """Sums of squared differences, and their gradients in place of the features."""
    here, there, scale = random(70, 6), random(70, 6, seed=1), 2 * 0.7
    forth, back = Kernel.get(device, "smoothness"), Kernel.get(device, "smoothness_bwd")
    content = np.frombuffer(forth.uniform("Smoothness", pairs=70, features=6, scale=scale), np.uint8)
    uniform = DeviceArray.upload(device, "smoothness", content)
    a, b, sums = on_device(device, here), on_device(device, there), on_device(device, torch.full((70,), torch.nan))
    with Commands(device) as commands:
        # In a column, as where the groups are too many for a row.
        commands.dispatch_grid(forth, (1, 2), smoothness=uniform, here=a, there=b, sums=sums)
        commands.dispatch(back, -(-70 * 6 // 64), smoothness=uniform, here=a, there=b)
    of_here, of_there = here.double().requires_grad_(), there.double().requires_grad_()
    exact = (of_there - of_here).square().sum(dim=1)
    (0.7 * exact.sum()).backward()
    assert relative(read(sums), exact.detach()) < 1e-6
    assert relative(read(a), of_here.grad) < 1e-6
    assert relative(read(b), of_there.grad) < 1e-6


def values_and_gradients(
    field: GridField, *, on_device: bool, nearby: Nearby | None = NEARBY, points: Tensor = POINTS
) -> tuple[list[Tensor], list[Tensor]]:
    field.on_device = on_device
    d = DYNAMICS[: len(points)].clone().requires_grad_() if field.config.dynamics_size else None
    move = field(points, 0.3, d, nearby)
    found = [part for part in parts(move) if part is not None]
    weights = [random(*part.shape, seed=seed) for seed, part in enumerate(found)]
    total = sum((part * weight).sum() for part, weight in zip(found, weights, strict=True))
    gradients = torch.autograd.grad(total, [*field.parameters(), *([] if d is None else [d])], allow_unused=True)
    return [part.detach() for part in found], [torch.zeros(1) if g is None else g for g in gradients]


@pytest.mark.parametrize("name", FIELDS)
def test_the_field_is_that_of_torch(device: Device, name: str) -> None:
    """Its values, and the gradients of all its parameters and of the dynamics attributes."""
    field = grid_field(device, FIELDS[name])
    expected, found = (values_and_gradients(field, on_device=there) for there in (False, True))
    for a, b in zip(expected[0], found[0], strict=True):
        torch.testing.assert_close(b, a, rtol=1e-5, atol=1e-5)
    for a, b in zip(expected[1], found[1], strict=True):
        assert relative(b, a) < 1e-5 or float(a.abs().max()) < 1e-6


def test_without_neighbours_and_with_few_points(device: Device) -> None:
    field = grid_field(device, PLAIN)
    for count in (1, 2):
        expected, found = (
            values_and_gradients(field, on_device=there, nearby=None, points=POINTS[:count]) for there in (False, True)
        )
        for a, b in zip([*expected[0], *expected[1]], [*found[0], *found[1]], strict=True):
            torch.testing.assert_close(b, a, rtol=1e-4, atol=1e-5)


def test_the_same_bits_each_time(device: Device) -> None:
    field = grid_field(device, PLAIN)
    first, second = (values_and_gradients(field, on_device=True) for _ in range(2))
    for a, b in zip([*first[0], *first[1]], [*second[0], *second[1]], strict=True):
        assert torch.equal(a, b)


def make_decoder(device: Device, field: GridField, *, block: int | None = None) -> Decoder:
    return Decoder(device, field._encoder, field._decoder.shape, block=block)


def decoder_inputs(field: GridField) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """200 points, and what the decoder takes beside their features: per point, and its weights."""
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    shape = field._decoder.shape
    weights = {name: random(*size, seed=i).requires_grad_() for i, (name, size) in enumerate(shape.weights.items())}
    return points, random(200, shape.beside).requires_grad_(), weights


def test_blocks_of_gaussians_give_the_same(device: Device) -> None:
    """Values to the last bit; gradients of weights are summed in another order."""
    field = grid_field(device, PLAIN)
    points, beside, weights = decoder_inputs(field)
    learnt = [beside, *weights.values(), *(grid.table for grid in field.grids)]
    runs = []
    for block in (None, 64):
        decoded = make_decoder(device, field, block=block)((points, 0.4), beside, weights)
        gradients = torch.autograd.grad(decoded.outputs.square().sum(), learnt)
        runs.append((decoded.outputs.detach(), gradients))
    assert torch.equal(runs[0][0], runs[1][0])
    for a, b in zip(runs[0][1], runs[1][1], strict=True):
        assert relative(a, b) < 1e-6


def test_submitted_in_parts_the_bits_are_the_same(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a watchdog ends long submissions: after each block of the decoder and each lookup of the encoder."""
    field = grid_field(device, PLAIN)
    points, beside, weights = decoder_inputs(field)
    learnt = [beside, *weights.values(), *(grid.table for grid in field.grids)]
    submitted, submit = [], Encoder.submit
    monkeypatch.setattr(Encoder, "submit", lambda *arguments: submitted.append(1) or submit(*arguments))
    runs, counts = [], []
    for watchdog in (False, True):
        monkeypatch.setattr(device, "watchdog", watchdog)
        submitted.clear()
        decoded = make_decoder(device, field, block=64)((points, 0.4), beside, weights)
        gradients = torch.autograd.grad(decoded.outputs.square().sum(), learnt)
        runs.append([decoded.outputs.detach(), *gradients])
        counts.append(len(submitted))
    assert all(map(torch.equal, *runs))
    assert counts[0] == 2
    assert counts[1] == 2 + 4 + 4 + 2  # 4 blocks, both ways; the static grid, and the slices of the temporal ones


@pytest.mark.parametrize("in_torch", [False, True])
def test_something_else_was_decoded_in_between(device: Device, *, in_torch: bool) -> None:
    """And the gradient is asked for twice: the features are gone then, and are made again."""
    field = grid_field(device, PLAIN)
    field.on_device = True
    learnt = list(field.parameters())
    alone = field(POINTS, 0.3, DYNAMICS, NEARBY)
    expected = torch.autograd.grad(alone.translation.square().sum() + alone.smoothness, learnt, allow_unused=True)
    move = field(POINTS, 0.3, DYNAMICS, NEARBY)
    with torch.set_grad_enabled(not in_torch):
        field(POINTS[:30], 0.8, DYNAMICS[:30])
    total = move.translation.square().sum() + move.smoothness
    for _ in range(2):
        found = torch.autograd.grad(total, learnt, retain_graph=True, allow_unused=True)
        for a, b in zip(found, expected, strict=True):
            assert (a is None and b is None) or torch.equal(a, b)


def test_without_gradients_the_field_is_torchs(device: Device) -> None:
    field = grid_field(device, PLAIN)
    with torch.no_grad():
        plain = field(POINTS, 0.3, DYNAMICS)
        field.on_device = True
        assert torch.equal(field(POINTS, 0.3, DYNAMICS).translation, plain.translation)


@pytest.mark.parametrize(
    ("config", "there"),
    [
        (FieldConfig(), True),
        (FieldConfig(kind="grid4d", motion="mlp"), True),
        (FieldConfig(depth=1), False),
        (FieldConfig(motion="mlp"), False),
        (FieldConfig(kind="hexplane"), False),
        (FieldConfig(kind="static"), False),
    ],
)
def test_which_fields(config: FieldConfig, *, there: bool) -> None:
    assert config.decodes_on_device == there
