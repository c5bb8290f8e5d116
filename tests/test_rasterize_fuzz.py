"""Bad, extreme and missing input never crashes, never spreads, and nothing depends on what the buffers held before."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.reference import near_discontinuity
from helpers.scenes import Scene, Step, front_camera, oblique_camera, random_scene, reference_step, relative, step

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.splat.rasterizer import Rasterizer

pytestmark = [pytest.mark.kernels, pytest.mark.subgroups]

Use = Callable[[Rasterizer], Rasterizer]
BACKGROUND = torch.tensor([0.2, 0.4, 0.9])
NAN, INF = math.nan, math.inf

# What makes a Gaussian invisible, wherever it stands.
UNSEEN: dict[str, dict[str, list[float] | float]] = {
    "NaN mean": {"means": [0.1, NAN, 2.0]},
    "infinite mean": {"means": [INF, 0.0, 2.0]},
    "minus infinite depth": {"means": [0.0, 0.0, -INF]},
    "huge mean": {"means": [1e30, 0.0, 2.0]},
    "behind": {"means": [0.0, 0.0, -2.0]},
    "in the camera": {"means": [0.0, 0.0, 0.0]},
    "NaN quaternion": {"quats": [NAN, 0.0, 0.0, 0.0]},
    "infinite quaternion": {"quats": [INF, 1.0, 0.0, 0.0]},
    "zero quaternion": {"quats": [0.0, 0.0, 0.0, 0.0]},
    "NaN scale": {"scales": [0.1, 0.1, NAN]},
    "infinite scale": {"scales": [INF, 0.1, 0.1]},
    "absurd scale": {"scales": [1e30, 1e30, 1e30]},
    "NaN opacity": {"opacities": NAN},
    "no opacity": {"opacities": 0.0},
    "negative opacity": {"opacities": -0.5},
}


def drawn(scene: Scene, device: Device, width: int = 33, height: int = 25, **how: Any) -> Step:
    return step(scene, front_camera(width, height), device, background=BACKGROUND, **how)


def in_front(count: int, seed: int, sh: int | None = None) -> Scene:
    scene = random_scene(count, seed, sh=sh, size=0.1)
    scene["means"] = 0.5 * scene["means"] + torch.tensor([0.0, 0.0, 2.5])
    return scene


def check_rest(bad: Scene, rows: torch.Tensor, good: Scene, device: Device, **how: Any) -> None:
    """The rows are as if they were not there: the same bits for the others, zeros for them."""
    found, expected = drawn(bad, device, **how), drawn(good, device, **how)
    for name in ("image", "alpha", "depth"):
        assert found.bits[name] == expected.bits[name], name
    assert not found.radii[rows].any()
    for name in (*good, "means2d"):
        assert not found.gradients[name][rows].any(), name
        assert torch.equal(found.gradients[name][~rows], expected.gradients[name]), name
    assert torch.equal(found.gradients["background"], expected.gradients["background"])


# One bad value


@pytest.mark.parametrize("antialiased", [False, True])
def test_invisible_gaussians_disturb_nobody(device: Device, antialiased: bool) -> None:
    """All kinds at once, among others that are seen: first, between and last."""
    good = in_front(40, 1)
    rows = torch.zeros(40 + 3 * len(UNSEEN), dtype=torch.bool)
    rows[: len(UNSEEN)] = rows[-len(UNSEEN) :] = rows[30 : 30 + len(UNSEEN)] = True
    kinds = list(UNSEEN.values()) * 3
    bad = {}
    for group, values in good.items():
        bad[group] = torch.empty(len(rows), *values.shape[1:])
        bad[group][~rows], bad[group][rows] = values, values[torch.arange(len(kinds)) % len(values)]
        for row, kind in zip(rows.nonzero()[:, 0].tolist(), kinds, strict=True):
            if group in kind:
                bad[group][row] = torch.tensor(kind[group])
    check_rest(bad, rows, good, device, antialiased=antialiased)


def test_only_invisible_gaussians(device: Device) -> None:
    scene = in_front(30, 3)
    scene["means"][:, 2] *= -1
    found = drawn(scene, device)
    assert torch.equal(found.image, BACKGROUND.expand(25, 33, 3))
    assert not found.alpha.any()
    assert not any(found.gradients[name].any() for name in scene)


# Extremes that can be seen


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        pytest.param("huge scale", {"scales": 1e3}, marks=pytest.mark.nightly),
        ("one huge axis", {"scales": torch.tensor([1e4, 1e-3, 1e-3])}),
        ("no scale", {"scales": 0.0}),
        ("denormal scale", {"scales": 1e-40}),
        ("full opacity", {"opacities": 1.0}),
        ("tiny quaternions", {"quats": torch.tensor([1e-15, 2e-15, 0.0, 0.0])}),
        ("large quaternions", {"quats": torch.tensor([1e15, 2e15, 0.0, 0.0])}),
        ("bright", {"colors": 1e6}),
        ("negative light", {"colors": -3.0}),
        ("next to the camera", {"means": torch.tensor([0.001, 0.002, 0.0101])}),
        ("far away", {"means": torch.tensor([10.0, -20.0, 1e6])}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_extremes_are_finite_and_as_in_float64(device: Device, name: str, changes: dict[str, float]) -> None:
    """Gradients are held to the reference's only where float32 can hold them."""
    scene, camera = in_front(12, 4), front_camera(33, 25)
    for group, value in changes.items():
        scene[group][::3] = value
    found = drawn(scene, device)
    expected = reference_step(scene, camera, background=BACKGROUND)
    fragile = near_discontinuity(**{k: v.double() for k, v in scene.items()}, camera=camera)
    scale = float(expected.image.abs().max()) + 1
    assert ((found.image - expected.image).abs()[~fragile] < 1e-4 * scale).all()
    assert torch.equal(found.radii > 0, expected.radii > 0)
    for group, gradient in found.gradients.items():
        assert gradient.isfinite().all(), group


# Nothing to draw, and next to nothing to draw on


@pytest.mark.parametrize("sh_degree", [None, 2])
def test_no_gaussians(device: Device, sh_degree: int | None) -> None:
    scene = random_scene(0, 0, sh=None if sh_degree is None else 9)
    found = step(scene, oblique_camera(9, 5), device, sh_degree=sh_degree, background=BACKGROUND)
    assert torch.equal(found.image, BACKGROUND.expand(5, 9, 3))
    assert found.alpha.shape == found.depth.shape == (5, 9)
    assert not found.alpha.any()
    assert not found.depth.any()
    assert found.radii.shape == (0,)
    assert found.radii.dtype == torch.int32
    assert found.means2d.shape == (0, 2)
    assert {name: tuple(g.shape) for name, g in found.gradients.items() if name in scene} == {
        name: tuple(value.shape) for name, value in scene.items()
    }
    unseen = random_scene(1, 0) | {"opacities": torch.zeros(1)}
    expected = step(unseen, oblique_camera(9, 5), device, background=BACKGROUND)
    torch.testing.assert_close(found.gradients["background"], expected.gradients["background"])


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (9, 17), (65, 3)])
def test_all_image_sizes(device: Device, size: tuple[int, int]) -> None:
    """Nothing is drawn past the border, and the border is drawn."""
    scene, camera = in_front(20, 5), front_camera(*size, focal=10.0)
    found = step(scene, camera, device, background=BACKGROUND)
    expected = reference_step(scene, camera, background=BACKGROUND)
    fragile = near_discontinuity(**{k: v.double() for k, v in scene.items()}, camera=camera)
    assert found.image.shape == (size[1], size[0], 3)
    assert ((found.image - expected.image).abs()[~fragile] < 2e-5).all()
    if not fragile.any():
        for name, gradient in expected.gradients.items():
            assert relative(found.gradients[name], gradient) < 1e-4, name


# What the buffers held before


PATTERNS = {
    "all bits": np.full(4, 0xFFFFFFFF, np.uint32),
    "NaN": np.full(4, 0x7FC00000, np.uint32),
    "infinity": np.full(4, 0x7F800000, np.uint32),
    "small numbers": np.array([1, 2, 3, 0], np.uint32),
}


def poison(rasterizer: Rasterizer, pattern: np.ndarray) -> int:
    """Overwrite every buffer that the rasterizer keeps, but for what it knows to be constant."""
    poisoned = 0
    for name, buffer in rasterizer.pool._buffers.items():
        if not name.startswith("constant "):
            buffer.write(np.resize(pattern, buffer.nbytes // 4))
            poisoned += 1
    return poisoned


@pytest.mark.parametrize(
    ("pattern", "count", "sh_degree"),
    [
        ("all bits", 300, 1),
        *(pytest.param(pattern, 300, 1, marks=pytest.mark.nightly) for pattern in PATTERNS if pattern != "all bits"),
        pytest.param("NaN", 1, None, marks=pytest.mark.nightly),
    ],
)
def test_poisoned_buffers_do_not_change_a_bit(
    device: Device, use: Use, pattern: str, count: int, sh_degree: int | None
) -> None:
    rasterizer = use(Rasterizer(device))
    scene, larger = in_front(count, 6, sh=sh_degree and 9), in_front(500, 7, sh=sh_degree and 16)
    expected = drawn(scene, device, sh_degree=sh_degree)
    for before in (scene, larger):
        drawn(
            before, device, 40, 48, sh_degree=sh_degree
        )  # so that the buffers are there, with room behind what is needed
        assert poison(rasterizer, PATTERNS[pattern]) > 20
        assert drawn(scene, device, sh_degree=sh_degree).bits == expected.bits


def test_a_picture_without_gradients_leaves_none(device: Device) -> None:
    with torch.no_grad():
        first = rasterize(**in_front(20, 11), camera=front_camera(33, 25), device=device)
    assert not any(tensor.requires_grad for tensor in first)
