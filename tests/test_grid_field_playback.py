"""Grid fields on the device against the formula of Scene4D in float64 torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.decoder_reference import decode_reference
from helpers.trained_scenes import CONFIGS, OURS, trained
from torch import Tensor, nn

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.playback import playback
from lapgs_wgpu.motion.playback.playback import GridFieldPlayback
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.scene_file import SceneFile
from lapgs_wgpu.splat.rotation import rotate

pytestmark = pytest.mark.kernels


def expected(scene: Scene4D, t: float) -> dict[str, Tensor]:
    """The formulas of docs/method.md, in float64."""
    field, config = scene.field, scene.field_config
    assert isinstance(field, GridField)
    p = {name: value.detach().double() for name, value in scene.parameters.items()}
    heads, look = decode_reference(field, scene.parameters["means"].detach(), p.get("dynamics"), t)
    turn, shift, d_quats, d_scales = heads.split((4, 3, 4, 3), dim=1)
    unit = nn.functional.normalize
    turn = unit(turn + turn.new_tensor([1.0, 0, 0, 0]), dim=1)
    dc, logits = p["sh_dc"], p["opacity_logits"]
    if look.shape[1]:
        dc = dc + look[:, None, :3]
        logits = logits + look[:, 3] if look.shape[1] == 4 else logits
    changed = p["log_scales"].exp().clamp(min=1e-7) + d_scales
    return {
        "means": rotate(turn, p["means"]) + shift,
        "quats": unit(unit(p["quats"], dim=1) + d_quats, dim=1),
        "scales": (changed.abs() if config.negative_scales == "mirror" else changed).clamp(min=1e-7),
        "opacities": logits.sigmoid(),
        "sh": torch.cat([dc, p["sh_rest"][:, :8]], dim=1),
    }


def device_field(scene: Scene4D) -> GridFieldPlayback:
    """The scene without torch, its buffers of what moves: colors as they are, rubbish elsewhere."""
    assert scene.field is not None
    parameters = {name: value.numpy(force=True) for name, value in scene.field.state_dict().items()}
    stored = {name: value.numpy(force=True) for name, value in scene.parameters.items()}
    field = GridFieldPlayback(SceneFile("", scene.field_config, scene.sh_degree, stored, parameters, {}), scene.device)
    for name in ("means", "quats", "scales", "opacities"):
        array = getattr(field._now, name)
        array.write(np.full(array.shape, np.nan, np.float32))
    return field


def check(scene: Scene4D, times: tuple[float, ...] = (0.37,)) -> None:
    field = device_field(scene)
    for t in times:
        out = field.at(t)
        for name, exact in expected(scene, t).items():
            found = torch.from_numpy(getattr(out, name).read()).double()
            size = exact.abs().amax(dim=tuple(range(1, exact.ndim)), keepdim=True).clamp(min=1)
            assert float(((found - exact).abs() / size).max()) < 1e-4, (name, t)
        assert out.scales.read().min() >= np.float32(1e-7)


@pytest.mark.parametrize("name", CONFIGS)
def test_every_kind_of_field(device: Device, name: str) -> None:
    check(trained(device, CONFIGS[name], 100), (0.0, 0.37, 1.0))


@pytest.mark.parametrize("count", [1, 7, 64, 255, 257, 1000])
def test_any_number_of_gaussians(device: Device, count: int) -> None:
    check(trained(device, OURS, count, seed=count))


def test_several_blocks(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many Gaussians as do not fit into one binding: each dispatch has its own range of the buffers."""
    monkeypatch.setattr(playback, "_BLOCK_BYTES", 1 << 15)
    check(trained(device, OURS, 1000), (0.2, 0.9, 0.2))


def test_no_gaussians(device: Device) -> None:
    device_field(trained(device, OURS, 0)).at(0.5)


def test_only_what_changes_is_written(device: Device) -> None:
    """The colors above their constant part stand in the buffer that is drawn, and stay."""
    scene = trained(device, replace(OURS, appearance="none"), 50)
    field = device_field(scene)
    before = field._now.sh.read()
    np.testing.assert_array_equal(field.at(0.4).sh.read(), before)


def test_the_same_bits_again(device: Device) -> None:
    scene = trained(device, OURS, 500)
    field = device_field(scene)
    found = [field.at(t).means.read().tobytes() for t in (0.3, 0.8, 0.3)]
    assert found[0] == found[2] != found[1]


@pytest.mark.parametrize("name", CONFIGS)
def test_the_parameters_are_those_of_the_module(device: Device, name: str) -> None:
    field = GridField(CONFIGS[name], device, seed=0)
    shapes = {key: tuple(value.shape) for key, value in field.state_dict().items()}
    assert parameter_shapes(CONFIGS[name]) == shapes
