"""Colors seen through `rasterize`: splats far apart, of which each fills the middle of its own square of pixels."""

import math

import pytest
import torch
from helpers.reference import color
from helpers.scenes import Scene, front_camera, random_scene, relative, step
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.splat.rasterizer import Rasterizer

pytestmark = pytest.mark.kernels

COLUMNS, ROWS, SQUARE = 6, 4, 16
COUNT = COLUMNS * ROWS
CAMERA = front_camera(COLUMNS * SQUARE, ROWS * SQUARE, 50.0)
MIDDLE = torch.arange(ROWS)[:, None] * SQUARE + SQUARE // 2, torch.arange(COLUMNS) * SQUARE + SQUARE // 2


def squares(colors: Tensor) -> Scene:
    """A Gaussian in the middle of each square, at depths from 1 to 3; where two meet, both are too faint to count."""
    depth = torch.linspace(1, 3, COUNT)
    pixels = (
        torch.stack([MIDDLE[1].expand(ROWS, COLUMNS), MIDDLE[0].expand(ROWS, COLUMNS)], dim=-1).reshape(-1, 2) + 0.5
    )
    centre = torch.tensor([CAMERA.width / 2, CAMERA.height / 2])
    return {
        "means": torch.cat([(pixels - centre) * depth[:, None] / 50.0, depth[:, None]], dim=1),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(COUNT, 1),
        "scales": (1.5 * depth / 50.0)[:, None].repeat(1, 3),
        "opacities": torch.full((COUNT,), 0.8),
        "colors": colors,
    }


def seen_colors(scene: Scene, device: Device, sh_degree: int | None) -> Tensor:
    """(N, 3) the color of each splat: that of its pixel, divided by the opacity there."""
    drawn = rasterize(**scene, camera=CAMERA, sh_degree=sh_degree, device=device)
    return (drawn.image[MIDDLE] / drawn.alpha[MIDDLE][..., None]).reshape(COUNT, 3)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_given_colors_pass_through(device: Device) -> None:
    """Whatever they are: nothing is cut at zero or one."""
    colors = 2 * normal(0, COUNT, 3)
    torch.testing.assert_close(seen_colors(squares(colors), device, None), colors, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("degree", "stored"), [(0, 1), (0, 4), (0, 16), (1, 4), (1, 9), (2, 9), (2, 16), (3, 16), (3, 20)]
)
def test_every_degree_and_any_number_stored(device: Device, degree: int, stored: int) -> None:
    scene = squares(0.3 * normal(degree, COUNT, stored, 3))
    expected = color(scene["colors"].double(), scene["means"].double(), CAMERA, degree)
    assert ((expected > 0) & (expected < 1)).double().mean() > 0.5
    torch.testing.assert_close(seen_colors(scene, device, degree).double(), expected, rtol=1e-5, atol=1e-5)


def test_degree_one_brightens_along_its_axis(device: Device) -> None:
    """3DGS's order and signs: the third coefficient grows with z, and all splats lie before the camera."""
    colors = torch.zeros(COUNT, 4, 3)
    colors[:, 2] = 0.5
    direction = torch.nn.functional.normalize(squares(colors)["means"], dim=1)
    expected = 0.5 + 0.5 * math.sqrt(3 / (4 * math.pi)) * direction[:, 2:].expand(-1, 3)
    torch.testing.assert_close(seen_colors(squares(colors), device, 1), expected, rtol=1e-5, atol=1e-5)


def test_no_gradient_where_the_color_is_cut_at_zero(device: Device) -> None:
    colors = torch.zeros(COUNT, 4, 3)
    colors[:, 0] = torch.tensor([-3.0, 0.5, 3.0])  # red is cut
    colors[:, 1:] = 0.1 * normal(1, COUNT, 3, 3)
    gradient = step(squares(colors), CAMERA, device, sh_degree=1).gradients["colors"]
    assert not gradient[:, :, 0].any()
    assert gradient[:, 0, 1:].abs().min() > 0


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_no_gradient_for_degrees_that_are_not_used(device: Device, degree: int) -> None:
    used = (degree + 1) ** 2
    scene = squares(0.3 * normal(2, COUNT, 16, 3))
    step(scene, CAMERA, device, sh_degree=3)  # leaves its gradients in the same buffers
    gradient = step(scene, CAMERA, device, sh_degree=degree).gradients["colors"]
    assert not gradient[:, used:].any()
    short = scene | {"colors": scene["colors"][:, :used].clone()}
    assert torch.equal(gradient[:, :used], step(short, CAMERA, device, sh_degree=degree).gradients["colors"])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_direction_of_view_carries_gradient_to_the_mean(device: Device, degree: int) -> None:
    """A loss on colors alone: moving a mean along its own ray of view changes none of them."""
    scene = squares(0.5 * normal(degree, COUNT, 16, 3))
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    drawn = rasterize(**leaves, camera=CAMERA, sh_degree=degree, device=device)
    # At the very centre of a splat the picture depends on its mean in no other way, to first order.
    weights = normal(3, ROWS, COLUMNS, 3)
    (drawn.image[MIDDLE] * weights).sum().backward()
    exact = {name: value.double().requires_grad_() for name, value in scene.items()}
    colors = color(exact["colors"], exact["means"], CAMERA, degree)
    (colors * 0.8 * weights.reshape(COUNT, 3)).sum().backward()
    assert leaves["means"].grad is not None
    assert exact["means"].grad is not None
    assert relative(leaves["means"].grad, exact["means"].grad) < 1e-3  # the centres are rounded to float32
    assert relative(leaves["colors"].grad, exact["colors"].grad) < 1e-5  # type: ignore[arg-type]


def test_harmonics_beyond_one_binding(device: Device, monkeypatch: pytest.MonkeyPatch, use: object) -> None:
    """1000 x 192 bytes against a limit of 160 KiB: two parts, and the same bits."""
    scene, camera = random_scene(1000, 4, sh=16, size=0.02), front_camera(64, 48)
    scene["means"][:, 2] += 3
    expected = step(scene, camera, device, sh_degree=3)
    monkeypatch.setitem(device.limits, "max-storage-buffer-binding-size", 160 << 10)
    use(Rasterizer(device, capacity=4096))  # type: ignore[operator]
    assert step(scene, camera, device, sh_degree=3).bits == expected.bits
