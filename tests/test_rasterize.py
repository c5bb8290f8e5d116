"""The whole rasterizer, forward and backward, against its float64 reference."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.scenes import (
    Scene,
    Weights,
    fragile_pixels,
    front_camera,
    needles,
    oblique_camera,
    random_scene,
    reference_step,
    relative,
    step,
)
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.raster_config import RasterConfig, cpu_config, gpu_config, subgroup_size
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.splat.rasterizer import Rasterizer

pytestmark = [pytest.mark.kernels, pytest.mark.subgroups]

BACKGROUND = torch.tensor([0.3, 1.0, 0.1])


def compare(
    device: Device,
    scene: Scene,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    antialiased: bool | float = False,
    weights: Weights | None = None,
    fragile_share: float = 0.1,
) -> None:
    """Forward to 2e-5 and every group of gradients to 1e-4, without the few pixels where rounding decides."""
    fragile = fragile_pixels(scene, camera, sh_degree, antialiased=antialiased)
    assert fragile.double().mean() <= fragile_share
    weights = (weights or Weights.random(camera)).without(fragile)
    how: dict[str, Any] = {"sh_degree": sh_degree, "background": background, "antialiased": antialiased}
    found = step(scene, camera, device, **how, weights=weights)
    expected = reference_step(scene, camera, **how, weights=weights)
    farthest = float(expected.depth.max()) + 1
    for name, tolerance in (("image", 2e-5), ("alpha", 2e-5), ("depth", 2e-5 * farthest)):
        error = float((getattr(found, name) - getattr(expected, name))[~fragile].abs().max())
        assert error <= tolerance, f"{name}: error {error:.1e}"
    seen = expected.radii > 0
    assert seen.any()
    assert torch.equal(found.radii > 0, seen)
    assert (found.radii - expected.radii).abs().max() <= 1
    assert relative(found.means2d[seen], expected.means2d[seen]) < 1e-5
    for name, gradient in expected.gradients.items():
        assert found.gradients[name].shape == gradient.shape
        assert not found.gradients[name][~seen].any() if name != "background" else True
        error = relative(found.gradients[name], gradient)
        assert error < 1e-4, f"gradient of {name}: relative error {error:.1e}"


@pytest.mark.parametrize(
    ("count", "size", "sh_degree", "stored", "with_background"),
    [
        (1, (17, 9), None, None, False),
        (7, (1, 1), 1, 4, True),
        (100, (17, 9), 0, 16, False),
        (100, (101, 61), None, None, True),
        (1000, (101, 61), 3, 16, True),
        pytest.param(5000, (101, 61), 3, 16, True, marks=pytest.mark.nightly),
    ],
)
def test_random_scenes(
    device: Device, count: int, size: tuple[int, int], sh_degree: int | None, stored: int | None, with_background: bool
) -> None:
    scene = random_scene(count, seed=count, sh=stored, size=0.3 if count < 10 else 0.05)
    if count < 10:
        scene["means"] *= 0.3  # into the image
    background = BACKGROUND if with_background else None
    compare(device, scene, oblique_camera(*size), sh_degree=sh_degree, background=background)


# Scenes where one part of the mathematics weighs more than elsewhere


def test_thin_splats(device: Device) -> None:
    camera = front_camera(101, 61)
    compare(device, needles(100, 1, camera, length=15.0), camera, background=BACKGROUND)


def test_opaque_splats(device: Device) -> None:
    """Alpha held at its largest, and pixels that stop long before their lists end."""
    scene, camera = random_scene(600, 2, size=0.2), oblique_camera(101, 61)
    scene["opacities"][::2] = 1.0
    compare(device, scene, camera, background=BACKGROUND)


def test_splats_beyond_the_frustum(device: Device) -> None:
    """Large Gaussians beside the image, where the Jacobian's x/z and y/z are held and pass no gradient."""
    scene, camera = random_scene(60, 4), front_camera(33, 25, 20.0)
    sides = torch.tensor([[-2.5, 0.3], [2.5, -0.2], [0.1, 2.2], [-0.4, -2.2], [2.3, 2.0], [0.2, 0.1]])
    scene["means"] = torch.cat([sides.repeat(10, 1), torch.full((60, 1), 1.5)], 1) + 0.4 * scene["colors"]
    scene["scales"] = 0.5 + 10 * scene["scales"].clamp(max=0.1)
    compare(device, scene, camera)


def test_splats_close_to_the_camera(device: Device) -> None:
    scene, camera = random_scene(200, 5, size=0.02, spread=0.1), front_camera(33, 25)
    scene["means"][:, 2] = scene["means"][:, 2].abs() + 0.02
    compare(device, scene, camera)


# Antialiased


@pytest.mark.parametrize(("count", "size", "sh_degree", "low_pass"), [(100, 0.3, None, 0.1), (1000, 0.05, 3, True)])
def test_antialiased_scenes(device: Device, count: int, size: float, sh_degree: int | None, low_pass: float) -> None:
    stored = None if sh_degree is None else (sh_degree + 1) ** 2
    scene = random_scene(count, seed=count, sh=stored, size=size)
    compare(device, scene, oblique_camera(101, 61), sh_degree=sh_degree, background=BACKGROUND, antialiased=low_pass)


@pytest.mark.nightly
def test_antialiased_thin_splats(device: Device) -> None:
    """Edge-on discs, a third of a pixel thick and less: most of what is left of them is their thickness' gradient."""
    scene, camera = random_scene(300, 7, size=0.1), front_camera(101, 61)
    scene["means"][:, 2] = scene["means"][:, 2].abs() + 1.5
    scene["quats"] = torch.tensor([1.0, 0, 0, 0]).repeat(300, 1) + 0.02 * scene["quats"]
    scene["scales"][:, 1] = 1e-3 * (1 + 9 * scene["colors"][:, 0])
    compare(device, scene, camera, antialiased=True)


def test_antialiased_light_does_not_depend_on_the_resolution(device: Device) -> None:
    """What a small splat covers, in the image's width: without, the dilation covers more the fewer pixels there are."""
    still = {"means": [0, 0, 2.0], "quats": [1.0, 0, 0, 0], "scales": [0.02] * 3, "opacities": 0.9, "colors": [1.0] * 3}
    scene = {name: torch.tensor([value], dtype=torch.float32) for name, value in still.items()}
    covered = []
    for antialiased in (True, False):
        for size in (128, 32):
            camera = front_camera(size, size, float(size))
            covered.append(
                float(rasterize(**scene, camera=camera, antialiased=antialiased).alpha.detach().sum()) / size**2
            )
    exact = 0.9 * 2 * torch.pi * (0.02 / 2) ** 2
    assert covered[0] == pytest.approx(exact, rel=0.03)  # alpha is cut off at 1/255
    assert covered[1] == pytest.approx(exact, rel=0.05)
    assert covered[3] > 2 * covered[2]


@pytest.mark.parametrize("output", Weights._fields)
def test_a_loss_on_one_output(device: Device, output: str) -> None:
    scene, camera = random_scene(200, 7, sh=4), oblique_camera(33, 25)
    weights = Weights.random(camera)
    only = weights._replace(**{name: 0 * value for name, value in weights._asdict().items() if name != output})
    compare(device, scene, camera, sh_degree=1, background=BACKGROUND, weights=only)


@pytest.mark.parametrize("output", ["image", "alpha", "depth"])
def test_outputs_that_no_loss_takes(device: Device, output: str) -> None:
    """The gradients are those of a loss that multiplies the others by zero."""
    scene, camera = random_scene(200, 7), oblique_camera(33, 25)
    leaves = [value.clone().requires_grad_() for value in (*scene.values(), BACKGROUND)]
    found = []
    for zero in (None, 0.0):
        drawn = rasterize(**dict(zip(scene, leaves, strict=False)), background=leaves[-1], camera=camera, device=device)
        loss = getattr(drawn, output).sum()
        if zero is not None:
            loss = loss + zero * (drawn.image.sum() + drawn.alpha.sum() + drawn.depth.sum())
        found.append(torch.autograd.grad(loss, leaves))
    for alone, beside in zip(*found, strict=True):
        assert torch.equal(alone, beside)


# Shapes of the kernels


def shapes(device: Device) -> list[RasterConfig]:
    """All that this device can run, the simplest first."""
    found = [cpu_config(0), RasterConfig(16, 16, 32, subgroups=False, lane_runs=False), gpu_config(0)]
    if subgroup_size(device):
        found += [cpu_config(subgroup_size(device)), gpu_config(subgroup_size(device))]
    return list(dict.fromkeys(found))


@pytest.mark.nightly
@pytest.mark.parametrize("sh_degree", [None, 1])
def test_all_shapes_draw_the_same(device: Device, use: Callable[[Rasterizer], Any], sh_degree: int | None) -> None:
    scene, camera = random_scene(1000, 8, sh=sh_degree and 4, size=0.08), oblique_camera(101, 61)
    weights = Weights.random(camera).without(fragile_pixels(scene, camera, sh_degree))
    steps = []
    for shape in shapes(device):
        use(Rasterizer(device, config=shape))
        steps.append(step(scene, camera, device, sh_degree=sh_degree, background=BACKGROUND, weights=weights))
    first = steps[0]
    for other in steps[1:]:
        for name in ("image", "alpha"):
            assert (getattr(other, name) - getattr(first, name)).abs().max() <= 1e-6
        assert (other.depth - first.depth).abs().max() <= 5e-6
        assert torch.equal(other.radii, first.radii)
        for name, gradient in first.gradients.items():
            assert relative(other.gradients[name], gradient) < 2e-5


def test_workgroups_that_are_cut_into_subgroups_are_noticed(device: Device, use: Callable[[Rasterizer], Any]) -> None:
    """And no pass uses shuffles from then on."""
    if not 0 < subgroup_size(device) < 32:
        pytest.skip("this device has no subgroups, or none of fewer than 32 lanes")
    scene, camera = random_scene(500, 8, size=0.08), oblique_camera(101, 61)
    whole, cut = gpu_config(0), replace(gpu_config(32), subgroups=True)
    weights = Weights.random(camera)
    steps = []
    for shape in (whole, cut):
        rasterizer = use(Rasterizer(device, config=shape))
        drawn = [step(scene, camera, device, background=BACKGROUND, weights=weights) for _ in range(2)]
        assert not rasterizer.config.subgroups
        steps += drawn
    for other in steps[1:]:
        assert torch.equal(other.image, steps[0].image)
        for name, gradient in steps[0].gradients.items():
            assert torch.equal(other.gradients[name], gradient)


def test_only_the_backward_pass_is_cut(device: Device, use: Callable[[Rasterizer], Any]) -> None:
    """The image is drawn again, in more rounds."""
    if subgroup_size(device) < 8:
        pytest.skip("this device has no subgroups, or none of 8 lanes")
    scene, camera = random_scene(300, 8, size=0.3), oblique_camera(20, 12)
    use(Rasterizer(device, config=replace(cpu_config(0), round_splats=8)))
    expected = step(scene, camera, device)
    rasterizer = use(Rasterizer(device, config=replace(cpu_config(8), round_splats=128)))
    mismatches = iter([True])

    def mismatch(name: str, drawn: Any) -> bool:
        if name == "rasterize" or not next(mismatches, False):
            return False
        rasterizer.config = rasterizer.config.without_subgroups()
        return True

    rasterizer._subgroup_mismatch = mismatch  # type: ignore[method-assign]
    found = step(scene, camera, device)
    assert rasterizer.plans.now.rounds > 1
    for name, gradient in expected.gradients.items():
        assert torch.equal(found.gradients[name], gradient), name


# The door for torch


def test_means2d_has_the_gradient_in_pixels(device: Device) -> None:
    """Where nothing but the place matters: moving the image's content by a pixel."""
    scene, camera = random_scene(1, 9), front_camera(33, 25)
    scene |= {"means": torch.tensor([[0.1, -0.2, 2.0]]), "opacities": torch.tensor([0.5])}
    drawn = rasterize(**scene, camera=camera, device=device)
    assert drawn.means2d.requires_grad
    assert drawn.means2d.tolist()[0] == pytest.approx([0.1 * 20 + 16.5, -0.2 * 20 + 12.5], abs=1e-4)
    column = torch.arange(33) + 0.5
    (drawn.alpha * column).sum().backward()
    assert drawn.means2d.grad is not None
    assert drawn.means2d.grad[0, 0].item() == pytest.approx(drawn.alpha.sum().item(), rel=0.05)  # the skipped rim
    with torch.no_grad():
        assert not rasterize(**scene, camera=camera, device=device).means2d.requires_grad


def test_radii_of_what_is_larger_than_whole_numbers(device: Device) -> None:
    """A needle that fills the image."""
    scene, camera = random_scene(1, 9), front_camera(33, 25)
    scene |= {"means": torch.tensor([[0.0, 0.0, 1.0]]), "scales": torch.tensor([[1e8, 1e-3, 1e-3]])}
    assert rasterize(**scene, camera=camera, device=device).radii.item() > 1e9


def test_only_what_is_asked_for_has_gradients(device: Device) -> None:
    scene, camera = random_scene(50, 10), oblique_camera(33, 25)
    expected = step(scene, camera, device, weights=Weights.random(camera)).gradients
    weights = Weights.random(camera)
    for name in scene:
        leaf = scene[name].clone().requires_grad_()
        drawn = rasterize(**(scene | {name: leaf}), camera=camera, device=device)
        torch.autograd.backward([drawn.image, drawn.alpha, drawn.depth], list(weights))
        assert leaf.grad is not None
        assert torch.equal(leaf.grad, expected[name])


def test_gradients_flow_on_through_torch(device: Device) -> None:
    """Tensors that are not leaves, not contiguous, or used twice."""
    scene, camera = random_scene(50, 11), oblique_camera(33, 25)
    expected = step(scene, camera, device).gradients
    log_scales = scene["scales"].log().requires_grad_()
    means = scene["means"].t().contiguous().requires_grad_()
    moved = scene | {"scales": log_scales.exp(), "means": means.t()}
    weights = Weights.random(camera)
    drawn = rasterize(**moved, camera=camera, device=device)
    torch.autograd.backward([drawn.image, drawn.alpha, drawn.depth], list(weights))
    torch.testing.assert_close(log_scales.grad, expected["scales"] * scene["scales"], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(means.grad, expected["means"].t(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"means": torch.zeros(5, 2)}, "means"),
        ({"scales": torch.zeros(5)}, "scales"),
        ({"colors": torch.zeros(5, 4, 3), "sh_degree": 2}, "colors"),
        ({"colors": torch.zeros(5, 25, 3), "sh_degree": 4}, "sh_degree"),
        ({"background": torch.zeros(4)}, "background"),
        ({"antialiased": -0.1}, "antialiased"),
        ({"antialiased": float("nan")}, "antialiased"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_arguments_are_named(device: Device, changes: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=f"rasterize: {name} must"):
        rasterize(**(random_scene(5, 0) | changes), camera=oblique_camera(9, 9), device=device)
