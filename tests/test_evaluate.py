"""The evaluation: 8-bit pictures on both sides, means over views, pictures of each view."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.signal import convolve2d

from lapgs_wgpu.data.views import View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.safetensors_file import pack_tensors
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.evaluate import BLOCKS, Lpips, evaluate, side_by_side, to_8_bit, write_metrics
from lapgs_wgpu.train.image_metrics import MS_SSIM_SMALLEST, ms_ssim
from lapgs_wgpu.train.run_folder import result_text

CAMERA = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=24, height=16)


@pytest.fixture(scope="module")
def scene(device: Device) -> Scene4D:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    colors = np.random.default_rng(1).uniform(0, 1, (40, 3))
    return Scene4D.from_points(points, colors, np.full(40, 0.1), FieldConfig(kind="static"), device=device)


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
    assert metrics["lpips"] == metrics["ms_ssim"] == metrics["views"][0]["lpips_unscaled"] == "not available"
    assert metrics["environment"]["adapter"] == scene.device.info.name
    panel = np.asarray(Image.open(tmp_path / "off.png"))
    assert np.array_equal(panel, side_by_side(off, drawn))


def test_no_views_are_told(scene: Scene4D) -> None:
    with pytest.raises(InputError, match="no views to measure"):
        evaluate(scene, (), "black")


@pytest.mark.parametrize(("background", "value"), [("black", 0), ("white", 255)])
def test_background_lies_under_both_sides(scene: Scene4D, background: str, value: int) -> None:
    clear = np.zeros((16, 24, 4), np.uint8)  # wholly transparent
    empty = Scene4D({name: row[:0] for name, row in scene.parameters.items()}, scene.field_config, scene.device)
    assert evaluate(empty, [view("clear", clear)], background)["psnr"] == pytest.approx(100)
    opaque = np.full((16, 24, 3), value, np.uint8)
    assert evaluate(empty, [view("opaque", opaque)], background)["psnr"] == pytest.approx(100)


def pictures(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    smooth = torch.nn.functional.avg_pool2d(a.permute(2, 0, 1), 5, stride=1, padding=2).permute(1, 2, 0)
    return smooth, (smooth + 0.05 * torch.randn(smooth.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)


@pytest.mark.parametrize("size", [(161, 161), (180, 203)])
def test_ms_ssim_written_out(size: tuple[int, int]) -> None:
    """Scale by scale with scipy's filters, which are not ours."""
    a, b = pictures(*size)
    x = np.arange(11) - 5
    window = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    values = []
    for channel in range(3):
        p, q = a[..., channel].numpy(), b[..., channel].numpy()
        product = 1.0
        for level, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
            means = [convolve2d(image, window, "valid") for image in (p, q, p * p, q * q, p * q)]
            vp, vq, cov = means[2] - means[0] ** 2, means[3] - means[1] ** 2, means[4] - means[0] * means[1]
            value = (2 * cov + 0.03**2) / (vp + vq + 0.03**2)
            if level == 4:
                value *= (2 * means[0] * means[1] + 0.01**2) / (means[0] ** 2 + means[1] ** 2 + 0.01**2)
            product *= value.mean() ** weight
            p, q = (
                torch.nn.functional.avg_pool2d(
                    torch.from_numpy(each)[None, None], 2, padding=(p.shape[0] % 2, p.shape[1] % 2)
                )[0, 0].numpy()
                for each in (p, q)
            )
        values.append(product)
    assert float(ms_ssim(a, b)) == pytest.approx(np.mean(values), abs=1e-9)
    assert float(ms_ssim(a, a)) == pytest.approx(1.0, abs=1e-9)
    assert MS_SSIM_SMALLEST == 161


def test_what_moves_is_measured_by_itself_and_drawn_from_beside(scene: Scene4D, tmp_path: Path) -> None:
    drawn = to_8_bit(scene.render(CAMERA, 0.5).image)
    moving = np.zeros((16, 24), bool)
    moving[4:12, 6:18] = True
    lost = np.where(moving[..., None], drawn + np.uint8(128), drawn)  # another color wherever something moves
    views = [
        dataclasses.replace(view("still", drawn), moving=lambda: ~moving & False),
        dataclasses.replace(view("lost", lost), moving=lambda: moving),
    ]
    metrics = evaluate(scene, views, "black", tmp_path)
    assert metrics["views"][0]["psnr_moving"] == "not available"
    assert metrics["psnr_still"] == pytest.approx(100)
    assert metrics["psnr_moving"] == pytest.approx(-20 * np.log10(128 / 255), abs=1e-3)
    assert metrics["ssim_moving"] < metrics["ssim_still"]
    assert metrics["explained"] < 0.2
    with Image.open(tmp_path / "off_lost.png") as picture:
        assert not np.array_equal(*np.split(np.asarray(picture), 2, axis=1))
    write_metrics(tmp_path, metrics)
    last = result_text(tmp_path).splitlines()
    assert last[0].startswith("warning: ")
    assert len(last) == 2


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, torch.nn.Sequential, list[torch.Tensor]]:
    """VGG16 in torchvision's layers, with random weights, and heads; and the file that holds them."""
    torch.manual_seed(0)
    layers: list[torch.nn.Module] = []
    for k, channels in enumerate(((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))):
        if k:
            layers.append(torch.nn.MaxPool2d(2))
        for out in channels:
            previous = next((m.out_channels for m in reversed(layers) if isinstance(m, torch.nn.Conv2d)), 3)
            layers += [torch.nn.Conv2d(previous, out, 3, padding=1), torch.nn.ReLU()]
    vgg = torch.nn.Sequential(*layers)
    heads = [torch.rand(1, block[-1][2], 1, 1) for block in BLOCKS]
    tensors = {f"features.{name}": value.numpy() for name, value in vgg.state_dict().items()}
    tensors |= {f"lin{k}.model.1.weight": head.numpy() for k, head in enumerate(heads)}
    file = tmp_path_factory.mktemp("weights") / "vgg.safetensors"
    file.write_bytes(b"".join(bytes(part) for part in pack_tensors(tensors, {})))
    return file, vgg, heads


def test_lpips_is_the_distance_of_vggs_features(
    network: tuple[Path, torch.nn.Sequential, list[torch.Tensor]],
) -> None:
    file, vgg, heads = network
    a, b = (image[:48, :40].float() for image in pictures(60, 60))
    lpips = Lpips(file)
    assert lpips(a, a) == 0
    for unscaled in (False, True):
        features = []
        for image in (a, b):
            x = (image if unscaled else 2 * image - 1).permute(2, 0, 1)
            x = (x - torch.tensor([-0.030, -0.088, -0.188])[:, None, None]) / torch.tensor([0.458, 0.448, 0.450])[
                :, None, None
            ]
            taps = []
            for i, layer in enumerate(vgg.requires_grad_(False)):
                x = layer(x)
                if i in (3, 8, 15, 22, 29):
                    taps.append(x / (x.norm(dim=0, keepdim=True) + 1e-10))
            features.append(taps)
        expected = sum(
            float(((p - q).square() * head[0]).sum(dim=0).mean()) for p, q, head in zip(*features, heads, strict=True)
        )
        assert lpips(a, b, unscaled=unscaled) == pytest.approx(expected, rel=1e-4)


def test_lpips_refuses_other_files(
    network: tuple[Path, torch.nn.Sequential, list[torch.Tensor]], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        Lpips(tmp_path / "nowhere")
    (tmp_path / "part").write_bytes(
        b"".join(map(bytes, pack_tensors({"features.0.bias": np.zeros(64, np.float32)}, {})))
    )
    with pytest.raises(InputError, match=r"features.0.weight must have the shape \(64, 3, 3, 3\), .* holds nothing"):
        Lpips(tmp_path / "part")


def test_lpips_is_measured_where_there_are_weights(
    scene: Scene4D, network: tuple[Path, torch.nn.Sequential, list[torch.Tensor]]
) -> None:
    large = CAMERA.resized(48, 32)
    drawn = to_8_bit(scene.render(large, 0.5).image)
    shown = View("a", large, 0.5, "a", lambda: 255 - drawn)
    metrics = evaluate(scene, [shown], "black", lpips=Lpips(network[0]))
    assert 0 < metrics["lpips"] != metrics["lpips_unscaled"] > 0
