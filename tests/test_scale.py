"""Much of everything: splats in one tile, tiles, intersections, workgroups, Gaussians; and none, or one.

Mesa's software driver ends a shader without a word when all loops of an invocation together have turned 65,535 times.
What is large runs with LAPGS_SOAK=1 alone (`make soak`).
"""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scenes import front_camera, random_scene
from helpers.training import configure
from synthetic import write_synthetic
from torch import Tensor

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.raster_config import raster_config
from lapgs_wgpu.splat.rasterize import rasterize, upload_gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer

Use = Callable[[Rasterizer], Rasterizer]
TILE = Camera(np.array([[40.0, 0, 4], [0, 40, 4], [0, 0, 1]]), np.eye(4), 8, 8)
ALPHA = 0.0042


def pile(count: int) -> dict[str, Tensor]:
    """Faint Gaussians of less than a pixel behind each other in one tile, at its 64 pixels in turn."""
    i = torch.arange(count)
    z = 2 + i.float() / count
    places = torch.stack([i % 8 - 3.5, i // 8 % 8 - 3.5], dim=1) / 40 * z[:, None]
    return {
        "means": torch.cat([places, z[:, None]], dim=1),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "scales": torch.full((count, 3), 1e-4),
        "opacities": torch.full((count,), ALPHA),
        "colors": torch.ones(count, 3) * (i[:, None] % 3 == torch.arange(3)),
    }


def drawn(
    scene: dict[str, Tensor],
    camera: Camera,
    device: Device,
    *,
    depth: bool = True,
    background: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> dict[str, Tensor]:
    """Outputs, and gradients of a weighted sum of the picture."""
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    out = rasterize(**leaves, camera=camera, depth=depth, background=torch.tensor(background), device=device)
    weights = torch.linspace(-1, 1, out.image.numel()).view_as(out.image)
    ((out.image * weights).sum() + out.alpha.sum()).backward()
    gradients = {f"d {name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return {"image": out.image.detach(), "alpha": out.alpha.detach(), **gradients}


def check_pile(count: int, device: Device) -> None:
    """Against what follows from the formulas: no pixel stops, and its splats differ in nothing but color."""
    found = drawn(pile(count), TILE, device)
    each = -(-count // 64)
    order = torch.arange(count) // 64
    weights = ALPHA * (1 - ALPHA) ** order.double()
    stop = weights * (1 - ALPHA) / ALPHA <= 1e-4
    weights = torch.where(stop, 0.0, weights)
    picture = torch.zeros(64, 3, dtype=torch.float64)
    picture.index_add_(0, torch.arange(count) % 64, weights[:, None] * pile(count)["colors"].double())
    assert each * 64 >= count
    assert (found["image"].reshape(64, 3) - picture).abs().max() < 2e-3 * picture.max()
    # The gradient by color is the splat's weight times the pixel's.
    d_image = torch.linspace(-1, 1, 192).view(64, 3).double()
    expected = weights[:, None] * d_image[torch.arange(count) % 64]
    assert (found["d colors"] - expected).abs().max() < 2e-3 * ALPHA
    assert torch.equal(found["d colors"] != 0, expected != 0)


@pytest.mark.kernels
@pytest.mark.subgroups
def test_lists_beyond_a_round_are_drawn_in_more(device: Device, use: Use) -> None:
    shape = raster_config(device)
    if not shape.round_splats:
        pytest.skip("this device has no rounds")
    rasterizer = use(Rasterizer(device))
    check_pile(5000 if shape.round_splats < 5000 else 40_000, device)
    assert rasterizer.plans.now.rounds > 1


@pytest.mark.nightly
@pytest.mark.kernels
@pytest.mark.subgroups
@pytest.mark.parametrize("depth", [False, True])
def test_rounds_change_no_bit(depth: bool, device: Device, use: Use, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many short rounds, with other tiles that are done long before, in bands and at once."""
    if not raster_config(device).round_splats:
        pytest.skip("this device has no rounds")
    scene, camera = random_scene(400, 3, size=0.3), front_camera(45, 37)
    scene["means"][:, 2] += 4
    scene["opacities"] *= 0.3
    use(Rasterizer(device))
    background = (0.2, 0.7, 0.4)
    expected = drawn(scene, camera, device, depth=depth, background=background)
    short = dataclasses.replace(raster_config(device), round_splats=16)
    for bands in (1, 2):
        rasterizer = use(Rasterizer(device, config=short))
        rasterizer.plans.now = dataclasses.replace(rasterizer.plans.now, bands=bands)
        found = drawn(scene, camera, device, depth=depth, background=background)
        assert rasterizer.plans.now.rounds >= 8
        for name in ("image", "alpha"):
            assert torch.equal(found[name], expected[name]), name
        for name, value in expected.items():
            assert torch.allclose(found[name], value, rtol=1e-4, atol=1e-5 * float(value.abs().max())), name
        if bands == 1:
            assert all(torch.equal(found[name], value) for name, value in expected.items())


@pytest.mark.kernels
def test_large_images_are_cut_so_that_a_splat_has_few_enough_tiles(
    device: Device, use: Use, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not raster_config(device).round_splats:
        pytest.skip("this device has no limit")
    scene, camera = random_scene(50, 3), front_camera(64, 64)
    expected = drawn(scene, camera, device)
    monkeypatch.setattr("lapgs_wgpu.splat.rasterizer.MAX_BAND_TILES", 20)
    rasterizer = use(Rasterizer(device))
    found = drawn(scene, camera, device)
    assert rasterizer.plans.now.bands == 4
    drawing = rasterizer.draw(upload_gaussians(rasterizer.pool, Gaussians(*scene.values())), camera)
    assert max(rasterizer._band_tiles(drawing, band) for band in range(4)) <= 20
    assert torch.equal(found["image"], expected["image"])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(write_synthetic(tmp_path_factory.mktemp("data") / "s", size=16, train_views=4, test_views=1))


NONE_BORN = {"density__max_world_size": "0", "density__gradient": "1"}


@pytest.mark.nightly
def test_a_training_that_loses_all_gaussians_says_so(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    changes = {**NONE_BORN, "density__max_world_size": "1e-6"}
    with pytest.raises(InputError, match=r"no Gaussian is left at step 30; raise density\.max_world_size"):
        train(configure(**changes), dataset, tmp_path / "run", device=device)


def test_a_training_goes_on_where_all_gaussians_are_faint(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    scene = train(configure(**NONE_BORN, density__min_opacity="0.999"), dataset, tmp_path / "run", device=device)
    assert len(scene) > 0


@pytest.mark.kernels
def test_a_number_of_intersections_beyond_32_bits_is_not_taken_for_a_small_one(device: Device) -> None:
    count, rasterizer = 140_000, Rasterizer(device)
    filling = [torch.zeros(count, 3), torch.ones(count, 4), torch.full((count, 3), 50.0), torch.ones(count)]
    filling[0][:, 2] = 2.0
    gaussians = upload_gaussians(rasterizer.pool, Gaussians(*filling, torch.ones(count, 3)))
    drawing = rasterizer.draw(gaussians, front_camera(2048, 2048, focal=2000.0))
    assert all(needed.read()[0] == 0xFFFFFFFF for needed in drawing.needed)


@pytest.mark.skipif(os.environ.get("LAPGS_SOAK") != "1", reason="large: LAPGS_SOAK=1 runs it")
def test_two_million_gaussians_on_a_4k_picture(device: Device) -> None:
    scene = random_scene(2_000_000, 5, size=0.002)
    scene["means"][:, 2] += 5
    found = drawn(scene, front_camera(3840, 2160, focal=3000.0), device, depth=False)
    assert all(value.isfinite().all() for value in found.values())
    assert float(found["alpha"].mean()) > 0.1
