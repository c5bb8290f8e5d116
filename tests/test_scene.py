"""The moving scene: its formula, its pictures, and the way to a file and back."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.ply_files import read_ply
from helpers.scene_files import CONFIG, DAMAGE, moving_scene, rewrite, with_grid
from helpers.scenes import oblique_camera
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.ply import GaussianSnapshot, write_ply
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_encoder import HashGrid
from lapgs_wgpu.motion.scene import Scene4D, load
from lapgs_wgpu.motion.timing import Timing
from lapgs_wgpu.splat.rasterize import rasterize

CAMERA = oblique_camera(48, 32)
TIMES = (0.0, 0.37, 1.0)


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


def test_a_picture_trains_every_parameter(device: Device) -> None:
    scene = moving_scene(device)
    now = scene.at(0.4)
    rendering = rasterize(*now.arrays().values(), CAMERA, sh_degree=now.sh_degree, device=device)
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
@pytest.mark.parametrize(("sh_degree", "antialiased"), [(0, False), (3, True), (0, 0.1)])
def test_a_loaded_scene_draws_the_same_bits(
    device: Device, tmp_path: Path, config: FieldConfig, sh_degree: int, antialiased: bool | float
) -> None:
    scene = moving_scene(device, config, sh_degree)
    other = pictures(scene)
    scene.antialiased = antialiased
    assert (pictures(scene) != other) == bool(antialiased)
    if antialiased:
        scene.timing = Timing(np.array([0.0, 0.3, 1.0]), np.array([0.1, 0.3, 0.6]))
    scene.save(tmp_path / "scene.ply", {"step": "1200"})
    again = load(tmp_path / "scene.ply", device)
    assert again.field_config == config
    assert again.sh_degree == sh_degree
    assert again.antialiased == antialiased
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
