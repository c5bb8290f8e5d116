"""The projection pass against its float64 reference."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from helpers.reference import ALPHA_MIN, NEAR, project
from helpers.scenes import Scene, front_camera, needles, oblique_camera, random_scene
from helpers.stages import all_of, capture

from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterize

pytestmark = pytest.mark.kernels

ROUND = [1.0, 0.0, 0.0, 0.0]


def projected(
    monkeypatch: pytest.MonkeyPatch, device: Device, scene: Scene, camera: Camera, *, antialiased: bool | float = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """(N, 12) what the pass leaves of each Gaussian, in float64 (see common/splat.wgsl), and (N,) its tile counts."""
    copies = capture(monkeypatch, "project", "splats", "tile_counts")
    rasterize(**scene, camera=camera, antialiased=antialiased, device=device)
    count = len(scene["means"])
    splats = all_of(copies[0]["splats"])[: 12 * count].reshape(count, 12)
    tile_counts = all_of(copies[0]["tile_counts"])[:count].astype(np.int64)
    return torch.from_numpy(splats).double(), torch.from_numpy(tile_counts)


def check(
    monkeypatch: pytest.MonkeyPatch, device: Device, scene: Scene, camera: Camera, *, antialiased: bool | float = False
) -> None:
    splats, tile_counts = projected(monkeypatch, device, scene, camera, antialiased=antialiased)
    geometry = [scene[name].double() for name in ("means", "quats", "scales", "opacities")]
    expected = project(*geometry, camera, antialiased=antialiased)
    seen = expected.visible
    assert torch.equal(splats[:, 10] > 0, seen)
    assert not tile_counts[~seen].any()
    splats = splats[seen]
    means2d, conics, depths, _, _, half_sides, opacities = (group[seen] for group in expected)
    size = max(camera.width, camera.height)
    reach = means2d.abs().amax(1, keepdim=True).clamp(min=size)
    assert ((splats[:, :2] - means2d) / reach).abs().max() < 1e-5
    assert ((splats[:, 2:5] - conics) / conics.abs().amax(1, keepdim=True)).abs().max() < 1e-4
    torch.testing.assert_close(splats[:, 5], opacities.log2(), rtol=0, atol=1e-5)
    torch.testing.assert_close(splats[:, 9], depths, rtol=1e-5, atol=0)
    largest = half_sides.amax(1)
    assert (splats[:, 10] >= largest * (1 - 1e-4)).all()
    assert (splats[:, 10] <= largest * (1 + 1e-4) + 1).all()
    torch.testing.assert_close(splats[:, 11], 1 / (conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2), rtol=1e-3, atol=0)


@pytest.mark.parametrize("antialiased", [False, True, 0.1])
@pytest.mark.parametrize(("count", "size", "spread"), [(1000, 0.05, 0.8), (1000, 0.5, 0.8), (1000, 0.003, 3.0)])
def test_random_gaussians(
    monkeypatch: pytest.MonkeyPatch, device: Device, count: int, size: float, spread: float, antialiased: bool | float
) -> None:
    scene = random_scene(count, 1, size=size, spread=spread)
    check(monkeypatch, device, scene, oblique_camera(101, 61), antialiased=antialiased)


def test_nothing_is_drawn_before_near(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    camera = oblique_camera(101, 61)
    scene = random_scene(1000, 1, size=0.05, spread=0.8)
    depths = camera.project(scene["means"].double().numpy())[1]
    near = dataclasses.replace(camera, near=float(np.median(depths)))
    check(monkeypatch, device, scene, near)
    splats, _ = projected(monkeypatch, device, scene, near)
    assert 100 < int((splats[:, 10] > 0).sum()) < 600


def test_needles(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """The determinant of a long thin splat is lost to cancellation where it is taken from the covariance."""
    camera = front_camera(320, 200)
    scene = needles(200, 2, camera)
    splats, _ = projected(monkeypatch, device, scene, camera)
    expected = project(*(scene[name].double() for name in ("means", "quats", "scales", "opacities")), camera)
    determinants = 1 / (expected.conics[:, 0] * expected.conics[:, 2] - expected.conics[:, 1] ** 2)
    seen = expected.visible
    assert seen.sum() > 100
    torch.testing.assert_close(splats[seen, 11], determinants[seen], rtol=1e-4, atol=0)


def single(**changes: object) -> Scene:
    values: dict[str, object] = {"means": [0, 0, 2.0], "quats": ROUND, "scales": [0.1] * 3, "opacities": 0.5}
    values |= {"colors": [1.0, 1, 1]} | changes
    return {name: torch.tensor([value], dtype=torch.float32) for name, value in values.items()}


@pytest.mark.parametrize(
    ("changes", "visible"),
    [
        ({"means": [0, 0, -2.0]}, False),
        ({"means": [0, 0, NEAR * 0.999], "scales": [1e-5] * 3}, False),
        ({"means": [0, 0, NEAR * 1.001], "scales": [1e-5] * 3}, True),
        ({"opacities": 0.0}, False),
        ({"opacities": ALPHA_MIN * 0.999}, False),
        ({"opacities": ALPHA_MIN * 1.001}, True),
        ({"quats": [0.0, 0, 0, 0]}, False),
        ({"means": [3.0, 0, 2.0]}, False),
        ({"means": [3.0, 0, 2.0], "scales": [1.0] * 3}, True),
        ({"means": [math.nan, 0, 2.0]}, False),
        ({"means": [0, 0, math.inf]}, False),
        ({"quats": [math.nan, 0, 0, 1.0]}, False),
        ({"scales": [0.1, math.nan, 0.1]}, False),
        ({"scales": [0.1, math.inf, 0.1]}, False),
        ({"opacities": math.nan}, False),
        ({"scales": [1e-30] * 3}, True),
        ({"scales": [1e30] * 3}, False),
    ],
    ids=str,
)
def test_who_is_seen(
    monkeypatch: pytest.MonkeyPatch, device: Device, changes: dict[str, object], visible: bool
) -> None:
    scene, camera = single(**changes), front_camera(33, 25)
    splats, tile_counts = projected(monkeypatch, device, scene, camera)
    assert bool(splats[0, 10] > 0) == visible
    assert visible or tile_counts[0] == 0
    drawn = rasterize(**scene, camera=camera, device=device)
    assert bool(drawn.radii[0] > 0) == visible
    assert drawn.image.isfinite().all()
    assert visible or not drawn.image.any()


@pytest.mark.nightly
def test_no_comparison_is_needed_against_nan(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """As a compiler may turn them round, which assumes that there is no NaN."""
    text = shader.shader_text

    def turned(name: str) -> str:
        source = text(name)
        if name == "project":
            for one, other in ((">", "<="), (">=", "<"), ("<", ">=")):
                source = re.sub(rf"!\(([\w.]+) {one} ([\w.]+)\)", rf"(\1 {other} \2)", source)
            assert "!(" not in source
        return source

    monkeypatch.setattr(device, "kernel_cache", {})
    monkeypatch.setattr(shader, "shader_text", turned)
    for name, ordinary in single().items():
        for i in range(ordinary.numel()):
            for bad in (math.nan, math.inf, -math.inf):
                scene = single()
                scene[name].view(-1)[i] = bad
                if name != "colors":
                    splats, tile_counts = projected(monkeypatch, device, scene, front_camera(33, 25))
                    assert not splats.any(), (name, i, bad)
                    assert not tile_counts.any(), (name, i, bad)


@pytest.mark.parametrize("scales", [[0.0, 0.0, 0.0], [1e-30] * 3, [0.1, 0.0, 0.0]], ids=str)
def test_antialiased_nothing_is_left_of_what_has_no_area(
    monkeypatch: pytest.MonkeyPatch, device: Device, scales: list[float]
) -> None:
    splats, tile_counts = projected(monkeypatch, device, single(scales=scales), front_camera(33, 25), antialiased=True)
    assert not splats.any()
    assert not tile_counts.any()


def test_beyond_the_frustum_the_jacobian_is_held(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """Large Gaussians beside the image, on all four sides."""
    camera = front_camera(33, 25, 20.0)
    rows = [single(means=[x, y, 1.0], scales=[1.0, 0.7, 0.4]) for x in (-3, 0, 3) for y in (-2.5, 0, 2.5)]
    scene = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
    check(monkeypatch, device, scene, camera)


def test_quaternions_of_any_length(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    scene, camera = random_scene(50, 3), oblique_camera(101, 61)
    first, _ = projected(monkeypatch, device, scene, camera)
    for factor in (-1.0, 1e-3, 1e3):
        again, _ = projected(monkeypatch, device, scene | {"quats": factor * scene["quats"]}, camera)
        torch.testing.assert_close(again[:, 2:5], first[:, 2:5], rtol=1e-4, atol=1e-6)
