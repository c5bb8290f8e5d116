"""The same step gives the same bits: again, after other steps, at any capacity, with anything left in the buffers."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers.scenes import Scene, Step, Weights, front_camera, oblique_camera, random_scene, relative, step

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.rasterize import rasterize, rasterizer_of
from lapgs_wgpu.splat.rasterizer import Rasterizer

pytestmark = [pytest.mark.kernels, pytest.mark.subgroups]

Use = Callable[[Rasterizer], Rasterizer]
CAMERA = oblique_camera(101, 61)
BACKGROUND = torch.tensor([0.3, 1.0, 0.1])
DEGREE = 1


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Behind all others stands a wall that can be seen in every tile, so that the last places of the lists count."""
    scene = random_scene(1500, 1, sh=4, size=0.08)
    scene["opacities"] *= 0.5
    wall = {"means": torch.from_numpy(2.5 * (CAMERA.T_cam_world[2, :3]) + [0.1, 0, 0]), "scales": torch.ones(3)}
    for name, value in wall.items():
        scene[name][700] = value
    scene["opacities"][700] = 0.9
    return scene


def one_step(scene: Scene, device: Device) -> Step:
    return step(scene, CAMERA, device, sh_degree=DEGREE, background=BACKGROUND)


@pytest.fixture(scope="module")
def expected(scene: Scene, device: Device) -> Step:
    """The step on the device's own rasterizer."""
    return one_step(scene, device)


def needed(rasterizer: Rasterizer) -> int:
    """Intersections of the last draw."""
    arrays = [rasterizer.pool.array(f"needed {band}", (3,), "uint32") for band in range(rasterizer.plans.now.bands)]
    return sum(int(array.read()[0]) for array in arrays)


def same(found: Step, expected: Step) -> None:
    different = [name for name, value in expected.bits.items() if found.bits[name] != value]
    assert not different


# Again


def test_the_same_step_again(device: Device, use: Use, scene: Scene, expected: Step) -> None:
    assert all(gradient.any() for gradient in expected.gradients.values())
    for _ in range(3):
        same(one_step(scene, device), expected)
    use(Rasterizer(device))
    same(one_step(scene, device), expected)


def test_backward_after_another_image_was_drawn(device: Device, scene: Scene, expected: Step) -> None:
    """Its buffers are gone by then: it is drawn again. Two images of one loss, as with two cameras a step."""
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    background = BACKGROUND.clone().requires_grad_()
    weights = list(Weights.random(CAMERA))
    drawn = rasterize(**leaves, camera=CAMERA, sh_degree=DEGREE, background=background, device=device)
    between = {name: value.clone().requires_grad_() for name, value in random_scene(400, 6, size=0.2).items()}
    camera = oblique_camera(64, 48)
    other = rasterize(**between, camera=camera, device=device)
    torch.autograd.backward([drawn.image, drawn.alpha, drawn.depth], weights)
    torch.autograd.backward([other.image, other.alpha, other.depth], list(Weights.random(camera)))
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        assert torch.equal(leaf.grad, expected.gradients[name])
    assert drawn.means2d.grad is not None
    assert torch.equal(drawn.means2d.grad, expected.gradients["means2d"])
    assert torch.equal(torch.as_tensor(background.grad), expected.gradients["background"])
    alone = step(random_scene(400, 6, size=0.2), camera, device)
    for name, leaf in between.items():
        assert leaf.grad is not None
        assert torch.equal(leaf.grad, alone.gradients[name])


def test_backward_twice(device: Device, scene: Scene) -> None:
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    drawn = rasterize(**leaves, camera=CAMERA, sh_degree=DEGREE, device=device)
    loss = (drawn.image * Weights.random(CAMERA).image).sum()
    first = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
    second = torch.autograd.grad(loss, list(leaves.values()))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


# Capacity


@pytest.fixture(scope="module")
def total(device: Device, expected: Step) -> int:
    return needed(rasterizer_of(device))


def test_capacity_does_not_matter(device: Device, use: Use, scene: Scene, expected: Step, total: int) -> None:
    """Too few places, which are drawn again with more, one too few, not one to spare, and many too many."""
    for capacity in (16, total - 1, total, 4 * total):
        rasterizer = use(Rasterizer(device, capacity=capacity))
        same(one_step(scene, device), expected)
        assert (
            rasterizer.plans.now.capacity == capacity if capacity >= total else rasterizer.plans.now.capacity >= total
        )
        assert rasterizer.plans.now.bands == 1


def test_a_small_image_does_not_pay_for_a_large_one(device: Device, use: Use, scene: Scene, expected: Step) -> None:
    """Each size has its plan, and finds it again."""
    rasterizer = use(Rasterizer(device, capacity=64))
    same(one_step(scene, device), expected)
    large = rasterizer.plans.now
    small = CAMERA.resized(CAMERA.width // 4, CAMERA.height // 4)
    first = step(scene, small, device, sh_degree=DEGREE)
    assert 64 < rasterizer.plans.now.capacity < large.capacity
    drawings = rasterizer._drawings
    same(one_step(scene, device), expected)
    assert rasterizer.plans.now == large
    same(step(scene, small, device, sh_degree=DEGREE), first)
    assert rasterizer._drawings == drawings + 2  # none was drawn twice


@pytest.mark.nightly
def test_passes_folded_into_two_dimensions(device: Device, use: Use, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if a dimension held 130 workgroups and not 65,535: Gaussians, intersections and tiles all need more."""
    scene, camera = random_scene(20_000, 8, size=0.01), oblique_camera(200, 160)
    expected = step(scene, camera, device)
    monkeypatch.setitem(device.limits, "max-compute-workgroups-per-dimension", 130)
    use(Rasterizer(device))
    same(step(scene, camera, device), expected)


# Bands of the image, where one binding does not hold all intersections


def banded(device: Device, use: Use, most: int) -> Rasterizer:
    rasterizer = use(Rasterizer(device, capacity=most))
    rasterizer.max_capacity = most
    return rasterizer


@pytest.mark.parametrize("share", [2, pytest.param(5, marks=pytest.mark.nightly)])
def test_bands_draw_the_same_image(
    device: Device, use: Use, scene: Scene, expected: Step, total: int, share: int
) -> None:
    rasterizer = banded(device, use, total // share)
    found = one_step(scene, device)
    assert rasterizer.plans.now.bands > share
    assert rasterizer.plans.now.capacity <= total // share
    for name in ("image", "alpha", "depth", "radii", "means2d"):
        assert found.bits[name] == expected.bits[name], name
    for name, gradient in expected.gradients.items():  # a splat's records are added band by band: other rounding
        assert relative(found.gradients[name], gradient) < 1e-4
    same(one_step(scene, device), found)
    again = banded(device, use, total // share)
    same(one_step(scene, device), found)
    assert again.plans.now.bands == rasterizer.plans.now.bands


@pytest.mark.nightly
def test_bands_with_backward_after_another_image(device: Device, use: Use, scene: Scene, total: int) -> None:
    banded(device, use, total // 3)
    expected = one_step(scene, device)
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    drawn = rasterize(**leaves, camera=CAMERA, sh_degree=DEGREE, background=BACKGROUND, device=device)
    rasterize(**random_scene(300, 9), camera=oblique_camera(40, 90), device=device)
    torch.autograd.backward([drawn.image, drawn.alpha, drawn.depth], list(Weights.random(CAMERA)))
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        assert torch.equal(leaf.grad, expected.gradients[name])


def test_pictures_that_are_looked_at_change_no_gradients(
    device: Device, use: Use, scene: Scene, expected: Step, total: int
) -> None:
    rasterizer = banded(device, use, 2 * total)
    rasterizer.plans.set_bands((CAMERA.width, CAMERA.height, False), 3)
    with torch.no_grad():
        rasterize(**scene, camera=CAMERA, sh_degree=DEGREE, background=BACKGROUND, device=device)
    assert rasterizer.plans.now.bands == 3
    same(one_step(scene, device), expected)
    assert rasterizer.plans.now.bands == 1


def test_bands_do_not_outlive_images_of_a_size(device: Device, use: Use, scene: Scene, total: int) -> None:
    rasterizer = banded(device, use, total // 3)
    expected = one_step(scene, device)
    bands = rasterizer.plans.now.bands
    assert bands > 1
    rasterize(**random_scene(30, 9), camera=oblique_camera(40, 90), device=device)
    assert rasterizer.plans.now.bands == 1
    same(one_step(scene, device), expected)
    assert rasterizer.plans.now.bands == bands


def test_a_row_of_tiles_that_does_not_fit_is_refused(device: Device, use: Use) -> None:
    camera = front_camera(64, 8)
    scene = random_scene(500, 10, size=2.0)
    scene["means"][:, 2] = 2.0
    banded(device, use, 512)
    expected = r"one row of tiles holds \d+ intersections, but the device's bindings hold 512"
    with pytest.raises(MemoryError, match=expected):
        step(scene, camera, device)


# Order


def test_the_order_of_the_gaussians_changes_nothing_but_their_rows(device: Device, scene: Scene) -> None:
    """Depths differ, so each pixel adds the same values in the same order."""
    assert len(scene["means"].unique(dim=0)) == len(scene["means"])
    order = torch.from_numpy(np.random.default_rng(0).permutation(len(scene["means"])))
    expected, found = (one_step(s, device) for s in (scene, {name: v[order] for name, v in scene.items()}))
    for name in ("image", "alpha", "depth"):
        assert found.bits[name] == expected.bits[name]
    for name in scene:
        assert torch.equal(found.gradients[name], expected.gradients[name][order])
