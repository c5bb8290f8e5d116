"""The passes of the decoder on the device and of the smoothness loss, against torch."""

import numpy as np
import pytest
import torch
from helpers.decoder_reference import gated
from helpers.matrices import on_device, random, read
from helpers.scenes import relative
from torch import Tensor

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.motion.fields.config import FieldConfig

pytestmark = pytest.mark.kernels


def gate_reference(layers: Tensor, *, motion: bool) -> Tensor:
    """(N, layers, width) -> (N, features, width)."""
    features = gated(layers[:, -1], layers[:, 0])
    return torch.stack([features, torch.relu(layers[:, 1])], dim=1) if motion else features[:, None]


@pytest.mark.parametrize("motion", [False, True])
@pytest.mark.parametrize(("count", "width"), [(1, 1), (37, 20)])
def test_gate(device: Device, count: int, width: int, *, motion: bool) -> None:
    layers = 2 * random(count, 3 if motion else 2, width)
    layers[0, 0, 0], layers[-1, 0, -1] = 200.0, -200.0  # a quotient of exponentials would overflow
    options = {"MOTION": 1} if motion else {}
    forth, back = Kernel.get(device, "gate", **options), Kernel.get(device, "gate_bwd", **options)
    uniform = DeviceArray.upload(device, "gate", np.array([count, width, 1], np.uint32))
    biases = 0.3 * random(*layers.shape[1:], seed=2)
    weights = on_device(device, torch.cat([torch.full((1,), torch.nan), biases.flatten()]))
    exact = layers.double().requires_grad_()
    expected = gate_reference(exact + biases.double(), motion=motion)
    d_features = random(*expected.shape, seed=1)
    (d_expected,) = torch.autograd.grad(expected, exact, d_features.double())
    of_layers, features = on_device(device, layers), on_device(device, torch.full(expected.shape, torch.nan))
    with Commands(device) as commands:
        groups = -(-count * width // 64)
        commands.dispatch(forth, groups, gate=uniform, weights=weights, layers=of_layers, features=features)
        d = on_device(device, d_features)
        commands.dispatch(back, groups, gate=uniform, weights=weights, d_features=d, layers=of_layers)
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


@pytest.mark.parametrize(
    ("config", "there"),
    [
        (FieldConfig(), True),
        (FieldConfig(kind="grid4d", motion="mlp"), True),
        (FieldConfig(depth=1), False),
        (FieldConfig(motion="mlp"), False),
        (FieldConfig(width=4096), False),
        (FieldConfig(kind="hexplane"), False),
        (FieldConfig(kind="static"), False),
    ],
)
def test_which_fields(config: FieldConfig, *, there: bool) -> None:
    assert config.decodes_on_device == there
