"""The moving scene: its formula, its pictures, and the way to a file and back."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import oblique_camera
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.checkpoint import read_checkpoint, write_checkpoint
from lapgs_wgpu.io.ply import GaussianSnapshot, read_ply, write_ply
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_encoder import HashGrid
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig
from lapgs_wgpu.motion.scene import Scene4D, draw, load

CONFIG = FieldConfig(
    bound=1.5,
    static=HashConfig(2, (4, 4, 4), (8, 8, 8)),
    temporal=HashConfig(2, (4, 4, 4), (8, 8, 6)),
    width=8,
)
CAMERA = oblique_camera(48, 32)
TIMES = (0.0, 0.37, 1.0)


def moving_scene(device: Device, config: FieldConfig = CONFIG, sh_degree: int = 2, count: int = 60) -> Scene4D:
    """With everything as training might leave it."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    parameters = {
        "means": 0.4 * normal(count, 3),
        "log_scales": normal(count, 3) * 0.5 - 2.5,
        "quats": 2 * normal(count, 4),
        "opacity_logits": normal(count),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": 0.2 * normal(count, 15, 3),
        "dynamics": normal(count, config.dynamics_size),
    }
    scene = Scene4D(parameters, config, device, sh_degree=sh_degree)
    if scene.field is not None:
        with torch.no_grad():
            for parameter in scene.field.parameters():
                parameter.copy_(0.3 * normal(*parameter.shape))
    return scene


def pictures(scene: Scene4D) -> list[bytes]:
    drawn = [scene.render(CAMERA, t, torch.tensor([0.1, 0.2, 0.3])) for t in TIMES]
    return [tensor.numpy().tobytes() for rendering in drawn for tensor in rendering]


# The formula


def turned(q: Tensor, v: Tensor) -> Tensor:
    """v turned by quaternion q (w, x, y, z), through q v q*."""

    def product(a: Tensor, b: Tensor) -> Tensor:
        w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdim=True)
        return torch.cat([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])], dim=1)

    conjugate = q * torch.tensor([1.0, -1, -1, -1])
    return product(product(q, torch.cat([torch.zeros(len(v), 1), v], dim=1)), conjugate)[:, 1:]


@pytest.mark.parametrize("t", TIMES)
def test_gaussians_at_a_time_written_out(device: Device, t: float) -> None:
    scene = moving_scene(device)
    p, found = scene.parameters, scene.at(t)
    assert scene.field is not None
    move = scene.field(p["means"], t, p["dynamics"])
    assert move.rotation is not None
    assert move.d_dc is not None
    torch.testing.assert_close(found.means, turned(move.rotation, p["means"]) + move.translation)
    quats = p["quats"] / p["quats"].norm(dim=1, keepdim=True) + move.d_quats
    torch.testing.assert_close(found.quats, quats / quats.norm(dim=1, keepdim=True))
    torch.testing.assert_close(found.scales, (p["log_scales"].exp() + move.d_scales).clamp(min=1e-7))
    torch.testing.assert_close(found.opacities, 1 / (1 + torch.exp(-p["opacity_logits"])))
    assert found.sh_degree == 2
    dc = p["sh_dc"] + move.d_dc[:, None]
    torch.testing.assert_close(found.sh, torch.cat([dc, p["sh_rest"][:, :8]], dim=1))
    assert (found.scales > 0).all()


def test_a_static_scene_stands_still(device: Device) -> None:
    scene = moving_scene(device, FieldConfig(kind="static"))
    assert scene.field is None
    still, later = scene.at(0.0), scene.at(0.8)
    assert torch.equal(still.means, scene.parameters["means"])
    assert torch.equal(still.means, later.means)
    assert torch.equal(still.scales, later.scales)


def test_an_untrained_field_leaves_the_scene_as_it_is(device: Device) -> None:
    trained = moving_scene(device)
    scene = Scene4D(trained.parameters, CONFIG, device)
    canonical, found = scene.canonical(), scene.at(0.6)
    torch.testing.assert_close(found.means, canonical.means)
    torch.testing.assert_close(found.quats, canonical.quats)
    torch.testing.assert_close(found.scales, canonical.scales)


def test_a_picture_trains_every_parameter(device: Device) -> None:
    scene = moving_scene(device)
    rendering = draw(scene.at(0.4), CAMERA, None, device)
    rendering.image.square().sum().backward()
    for name, parameter in scene.parameters.items():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
    assert scene.field is not None
    for name, parameter in scene.field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name


def test_no_gaussians(device: Device, tmp_path: Path) -> None:
    scene = moving_scene(device, count=0)
    assert len(scene.at(0.5)) == 0
    assert not scene.render(CAMERA, 0.5).image.any()
    with pytest.raises(InputError, match="0 Gaussians"):
        scene.save(tmp_path / "empty.ply")
    assert not list(tmp_path.iterdir())


@pytest.mark.kernels
def test_a_picture_is_the_same_without_its_depth(device: Device) -> None:
    scene, background = moving_scene(device), torch.tensor([0.1, 0.2, 0.3])
    for t in TIMES:
        whole, bare = (scene.render(CAMERA, t, background, depth=depth) for depth in (True, False))
        for name in ("image", "alpha", "radii", "means2d"):
            assert torch.equal(getattr(whole, name), getattr(bare, name)), name
        assert whole.depth.any()
        assert not bare.depth.any()


def test_from_points(device: Device) -> None:
    points, colors = np.array([[0.0, 1, 2], [3, 4, 5]]), np.array([[0.0, 0.5, 1.0], [0.2, 0.3, 0.4]])
    scene = Scene4D.from_points(points, colors, np.array([0.1, 0.2]), CONFIG, opacity=0.3, device=device)
    found = scene.at(0.0)
    np.testing.assert_array_equal(found.means.detach(), points.astype(np.float32))
    torch.testing.assert_close(found.scales, torch.tensor([[0.1] * 3, [0.2] * 3]))
    torch.testing.assert_close(found.opacities, torch.full((2,), 0.3))
    assert found.sh_degree == 0
    constant = 0.5 / math.sqrt(math.pi)
    torch.testing.assert_close(0.5 + constant * found.sh[:, 0], torch.tensor(colors, dtype=torch.float32))


# To a file and back


@pytest.mark.parametrize("config", [CONFIG, FieldConfig(kind="static")], ids=["moving", "static"])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_a_loaded_scene_draws_the_same_bits(
    device: Device, tmp_path: Path, config: FieldConfig, sh_degree: int
) -> None:
    scene = moving_scene(device, config, sh_degree)
    scene.save(tmp_path / "scene.ply", {"step": "1200"})
    again = load(tmp_path / "scene.ply", device)
    assert again.field_config == config
    assert again.sh_degree == sh_degree
    assert again.metadata == {"step": "1200"}
    for name, parameter in scene.parameters.items():
        assert torch.equal(again.parameters[name], parameter)
    assert pictures(again) == pictures(scene)
    again.save(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "scene.ply").read_bytes()


def test_the_still_is_the_scene_at_time_zero(device: Device, tmp_path: Path) -> None:
    """What a viewer shows that knows nothing of motion."""
    scene = moving_scene(device, sh_degree=3)
    scene.save(tmp_path / "scene.ply")
    still, expected = read_ply(tmp_path / "scene.ply"), scene.at(0.0)
    torch.testing.assert_close(torch.from_numpy(still.means), expected.means.detach())
    torch.testing.assert_close(torch.from_numpy(still.log_scales).exp(), expected.scales.detach())
    torch.testing.assert_close(torch.from_numpy(still.sh), expected.sh.detach())
    torch.testing.assert_close(torch.from_numpy(still.opacity_logits).sigmoid(), expected.opacities.detach())


def test_a_plain_ply_is_a_static_scene(device: Device, tmp_path: Path) -> None:
    source = moving_scene(device, FieldConfig(kind="static"), sh_degree=1)
    p = {name: value.detach().numpy() for name, value in source.parameters.items()}
    sh = np.concatenate([p["sh_dc"], p["sh_rest"][:, :3]], axis=1)
    still = GaussianSnapshot(p["means"], sh, p["opacity_logits"], p["log_scales"], p["quats"])
    write_ply(tmp_path / "plain.ply", still)
    scene = load(tmp_path / "plain.ply", device)
    assert scene.field is None
    assert scene.field_config.kind == "static"
    assert scene.sh_degree == 3  # 3DGS's files have all coefficients
    assert not scene.parameters["sh_rest"][:, 3:].any()
    assert pictures(scene) == pictures(source)


# Damage


def rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, str]], object]) -> None:
    """The file again, with its tensors and metadata changed."""
    still, tensors, metadata = read_checkpoint(path)
    change(tensors, metadata)
    write_checkpoint(path, still, tensors, metadata)


def with_field(**changes: object) -> Callable[[dict[str, Any], dict[str, str]], object]:
    def change(_: dict[str, Any], metadata: dict[str, str]) -> None:
        metadata["field"] = json.dumps(json.loads(metadata["field"]) | changes)

    return change


def with_grid(**changes: object) -> Callable[[dict[str, Any], dict[str, str]], object]:
    def change(_: dict[str, Any], metadata: dict[str, str]) -> None:
        values = json.loads(metadata["field"])
        metadata["field"] = json.dumps(values | {"temporal": values["temporal"] | changes})

    return change


DAMAGE: dict[str, tuple[Callable[[dict[str, Any], dict[str, str]], object], str]] = {
    "no field": (lambda _, m: m.pop("field"), "description of its field"),
    "no degree": (lambda _, m: m.pop("sh_degree"), "description of its field"),
    "not JSON": (lambda _, m: m.update(field="{"), "description of its field"),
    "another type": (lambda _, m: m.update(field="[1, 2]"), "description of its field"),
    "degree in words": (lambda _, m: m.update(sh_degree="three"), "description of its field"),
    "degree 4": (lambda _, m: m.update(sh_degree="4"), "sh_degree 4 is outside 0 to 3"),
    "unknown kind": (with_field(kind="quantum"), "kind is 'quantum'"),
    "unknown key": (with_field(colour="red"), "description of its field"),
    "a grid missing": (with_field(static=None), "description of its field"),
    "width 0": (with_field(width=0), "width must be 1 to 4096, got 0"),
    "absurd width": (with_field(width=10**9), "width must be 1 to 4096"),
    "width in words": (with_field(width="wide"), "description of its field"),
    "fractional width": (with_field(width=8.5), "description of its field"),
    "fractional depth": (with_field(depth=0.5), "description of its field"),
    "true for a width": (with_field(width=True), "description of its field"),
    "fractional table": (with_grid(table_log2=18.5), "description of its field"),
    "time in words": (with_field(time_scale="slow"), "description of its field"),
    "NaN time": (with_field(time_scale=math.nan), "got 1.5 and nan"),
    "time beyond its axis": (with_field(time_scale=50.0), "got 1.5 and 50"),
    "bound 0": (with_field(bound=0), "bound must be above 0"),
    "NaN bound": (with_field(bound=math.nan), "got nan and 0.9"),
    "no levels": (with_grid(levels=0), "levels must be 1 to 64"),
    "absurd levels": (with_grid(levels=10**6), "levels must be 1 to 64"),
    "fractional levels": (with_grid(levels=2.5), "description of its field"),
    "absurd table": (with_grid(table_log2=60), "table_log2 1 to 24, got 2 and 60"),
    "negative resolution": (with_grid(base=[-4, 4, 4]), "2 to 65536 entries, got -4"),
    "absurd resolution": (with_grid(finest=[10**6, 8, 8]), "2 to 65536 entries, got 1000000"),
    "two axes": (with_grid(base=[4, 4]), "description of its field"),
    "absurd planes": (
        with_field(planes={"features": 10**6, "space": 8, "time": 8, "levels": 1}),
        "features must be 1 to",
    ),
    "no dynamics": (with_field(dynamics=-1), "dynamics must be 0 to 256, got -1"),
    "hash in words": (with_field(temporal_hash="yes"), "wrong type"),
    "other levels": (with_grid(levels=3), "has shape"),
    "other width": (with_field(width=9), "has shape"),
    "a tensor missing": (lambda t, _: t.pop("gaussians.quats"), "no tensor 'gaussians.quats'"),
    "a dynamics row missing": (
        lambda t, _: t.update({"gaussians.dynamics": t["gaussians.dynamics"][1:]}),
        r"gaussians.dynamics' has shape \(59, 16\)",
    ),
    "a weight missing": (lambda t, _: t.pop("field.heads.bias"), "no tensor 'field.heads.bias'"),
    "a row missing": (lambda t, _: t.update({"gaussians.means": t["gaussians.means"][1:]}), r"has shape \(59, 3\)"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_refused_in_one_sentence(device: Device, tmp_path: Path, name: str) -> None:
    change, message = DAMAGE[name]
    path = tmp_path / "scene.ply"
    moving_scene(device).save(path)
    rewrite(path, change)
    with pytest.raises(InputError, match=message) as caught:
        load(path, device)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sizes_are_compared_before_memory_is_asked_for(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A description may ask for tables of many GB that the file does not hold."""
    path = tmp_path / "scene.ply"
    moving_scene(device).save(path)
    rewrite(path, with_grid(levels=64, table_log2=24, finest=[65536] * 3))

    def built(*_: object) -> None:
        raise AssertionError("the grid was built")

    monkeypatch.setattr(HashGrid, "__init__", built)
    with pytest.raises(InputError, match="has shape"):
        load(path, device)


def test_a_scene_with_nan_is_not_saved(device: Device, tmp_path: Path) -> None:
    scene = moving_scene(device)
    scene.save(tmp_path / "scene.ply")
    before = (tmp_path / "scene.ply").read_bytes()
    with torch.no_grad():
        scene.parameters["means"][3, 1] = math.nan
    with pytest.raises(InputError):
        scene.save(tmp_path / "scene.ply")
    assert (tmp_path / "scene.ply").read_bytes() == before
