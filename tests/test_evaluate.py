"""The evaluation: 8-bit pictures on both sides, means over views, pictures of each view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lapgs_wgpu.data.views import View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.field import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.evaluate import evaluate, side_by_side, to_8_bit

CAMERA = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=24, height=16)


@pytest.fixture(scope="module")
def scene(device: Device) -> Scene4D:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    colours = np.random.default_rng(1).uniform(0, 1, (40, 3))
    return Scene4D.from_points(points, colours, np.full(40, 0.1), FieldConfig(kind="static"), device=device)


def view(name: str, pixels: np.ndarray) -> View:
    return View(name, CAMERA, 0.5, name, lambda: pixels.copy())


def test_pictures_are_clamped_and_rounded() -> None:
    image = torch.tensor([[[-1.0, 0.0, 0.4999 / 255], [0.5001 / 255, 254.6 / 255, 7.0]]])
    assert to_8_bit(image).tolist() == [[[0, 0, 0], [1, 255, 255]]]


def test_side_by_side_shows_four_times_the_error() -> None:
    truth = np.full((2, 3, 3), 100, np.uint8)
    image = np.full((2, 3, 3), 90, np.uint8)
    image[0, 0] = 250
    panel = side_by_side(truth, image)
    assert panel.shape == (2, 9, 3)
    assert np.array_equal(panel[:, :3], truth)
    assert np.array_equal(panel[:, 3:6], image)
    assert panel[0, 6].tolist() == [255] * 3
    assert panel[1, 8].tolist() == [40] * 3


def test_metrics_are_means_over_views_of_8_bit_pictures(scene: Scene4D, tmp_path: Path) -> None:
    drawn = to_8_bit(scene.render(CAMERA, 0.5).image)
    off = drawn.copy()
    off[:, :, 1] ^= 8  # an error of 8 in one of three channels
    metrics = evaluate(scene, [view("equal", drawn), view("off", off)], "black", tmp_path)
    expected = -10 * np.log10((8 / 255) ** 2 / 3)
    assert [row["view"] for row in metrics["views"]] == ["equal", "off"]
    assert metrics["views"][0]["psnr"] == pytest.approx(100)  # of equal 8-bit pictures: the rendering was rounded
    assert metrics["views"][1]["psnr"] == pytest.approx(expected, abs=1e-4)
    assert metrics["psnr"] == pytest.approx((100 + expected) / 2, abs=1e-4)
    assert metrics["views"][0]["ssim"] == pytest.approx(1, abs=1e-6)
    assert metrics["gaussians"] == 40
    assert metrics["size"] == [24, 16]
    assert metrics["lpips"] == "not available"
    assert metrics["environment"]["adapter"] == scene.device.info.name
    panel = np.asarray(Image.open(tmp_path / "off.png"))
    assert np.array_equal(panel, side_by_side(off, drawn))


@pytest.mark.parametrize(("background", "value"), [("black", 0), ("white", 255), ("random", 0)])
def test_background_lies_under_both_sides(scene: Scene4D, background: str, value: int) -> None:
    clear = np.zeros((16, 24, 4), np.uint8)  # wholly transparent
    empty = Scene4D({name: row[:0] for name, row in scene.parameters.items()}, scene.field_config, scene.device)
    assert evaluate(empty, [view("clear", clear)], background)["psnr"] == pytest.approx(100)
    opaque = np.full((16, 24, 3), value, np.uint8)
    assert evaluate(empty, [view("opaque", opaque)], background)["psnr"] == pytest.approx(100)


def test_an_unreadable_picture_is_named(scene: Scene4D) -> None:
    def fail() -> np.ndarray:
        raise InputError("test/r_000.png cannot be decoded")

    with pytest.raises(InputError, match="r_000"):
        evaluate(scene, [View("a", CAMERA, 0.0, "a", fail)], "black")
