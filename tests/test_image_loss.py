"""The kernels of the image losses against their references in float64, and a step that reads back losses alone."""

import numpy as np
import pytest
import torch
from helpers import loss_reference
from helpers.image_losses import (
    BACKGROUND,
    CAMERA,
    TRUTH,
    WEIGHTS,
    Pair,
    Picture,
    gaussians,
    gradients,
    random_pair,
    step,
)
from helpers.loss_reference import total
from helpers.rounding import divides_exactly
from helpers.scenes import relative
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.train import exchange_step, image_metrics
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.exchange_step import RenderLoss, render_loss
from lapgs_wgpu.train.ground_truth import upload_rgba
from lapgs_wgpu.train.image_loss import ImageLoss

pytestmark = pytest.mark.kernels

SIZES = [(1, 1), (1, 9), (2, 5), (3, 3), (3, 4), (5, 70), (10, 13), (11, 11), (12, 30), (37, 61), (64, 64), (131, 90)]


def structured_pair(height: int, width: int, flat: bool = True) -> Pair:
    """Waves, an edge, a white channel, a corner that is white in both; one that is flat in the image alone."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    truth = np.stack([0.5 + 0.4 * np.sin(9 * x + 5 * y), 0.8 * (x > 0.4) + 0.1 * y, np.ones_like(x)], -1)
    truth[: height // 3, width // 2 :] = 0
    # Its noise keeps differences away from 0, where rounding decides on their sign.
    noise = 2e-3 * np.random.default_rng(0).standard_normal((height, width, 3))
    image = 0.9 * truth + 0.05 * np.sin(20 * x * y)[..., None] + noise
    image[height // 2 :, : width // 3] = truth[height // 2 :, : width // 3] = 1
    if flat:
        image[: height // 4, : width // 4] = 0.7
    return Pair(image.clip(0, 1).astype(np.float32), np.round(255 * truth).astype(np.uint8))


def record(losses: ImageLoss, pair: Pair, weights: LossWeights) -> tuple[NDArray[np.float32], Picture]:
    """Terms (5,) and gradient (H, W, 3)."""
    height, width = pair.image.shape[:2]
    planes = np.concatenate([pair.image.transpose(2, 0, 1), np.full((1, height, width), np.nan, np.float32)])
    image = DeviceArray.upload(losses.device, "image", planes)
    truth = upload_rgba(losses.device, pair.truth)
    with Commands(losses.device) as commands:
        terms, d_image = losses.record(commands, image, truth, weights)
    planes = d_image.read()
    assert (planes[3] == 0).all()
    return terms.read(), planes[:3].transpose(1, 2, 0)


def smooth_pair(height: int, width: int) -> Pair:
    """Without a region of constant difference, on whose bands, which are 0, rounding decides on the sign."""
    return structured_pair(height, width, flat=False)


def loss_of(terms: NDArray[np.float32], weights: LossWeights) -> float:
    return float(np.dot(terms.astype(float), [weights.l1, 0, weights.ssim, weights.pyramid, weights.ncc]))


def reference(pair: Pair, weights: LossWeights) -> tuple[float, torch.Tensor]:
    image = torch.from_numpy(pair.image).double().requires_grad_()
    loss = total(image, torch.from_numpy(pair.truth.astype(np.float32) / np.float32(255)).double(), weights)
    loss.backward()
    assert image.grad is not None
    return loss.item(), image.grad


def check(losses: ImageLoss, pair: Pair, weights: LossWeights) -> None:
    terms, gradient = record(losses, pair, weights)
    expected, expected_gradient = reference(pair, weights)
    assert loss_of(terms, weights) == pytest.approx(expected, rel=1e-5, abs=1e-6)
    # The pyramid's gradient takes signs of bands; where these are nearly 0, the rounding of the image's bytes decides.
    near = 1e-4 if weights.pyramid == 0 or divides_exactly(losses.device) else 5e-2
    assert relative(torch.from_numpy(gradient.copy()), expected_gradient) < near


@pytest.fixture(scope="module")
def image_loss(device: Device) -> ImageLoss:
    return ImageLoss(device)


# Against the references


@pytest.mark.parametrize("name", WEIGHTS)
def test_value_and_gradient(image_loss: ImageLoss, name: str) -> None:
    structured = structured_pair if WEIGHTS[name].pyramid == 0 else smooth_pair
    for size in SIZES:
        check(image_loss, random_pair(*size), WEIGHTS[name])
        check(image_loss, structured(*size), WEIGHTS[name])


@pytest.mark.parametrize("run", [7, 1 << 14])
def test_runs_of_any_length(device: Device, run: int) -> None:
    """How a lane's work is cut does not show."""
    losses = ImageLoss(device)
    losses._run = run
    for size in ((37, 61), (12, 30)):
        check(losses, smooth_pair(*size), WEIGHTS["all"])


@pytest.mark.parametrize(
    "truth", [structured_pair(40, 30).truth, np.arange(768).astype(np.uint8).reshape(16, 16, 3)], ids=["scene", "bytes"]
)
def test_equal_images(image_loss: ImageLoss, truth: NDArray[np.uint8]) -> None:
    """Every byte is exactly the float that numpy makes of it, whatever the driver's division (shaders/common/picture):
    a difference of one ulp would give L1 and the pyramid their full gradient, 3e-4 here."""
    terms, gradient = record(image_loss, Pair(truth.astype(np.float32) / np.float32(255), truth), WEIGHTS["all"])
    np.testing.assert_allclose(terms, [0, 0, 0, 0, 0], atol=2e-3)  # NCC of flat windows: sqrt(tiny) / e
    np.testing.assert_allclose(terms[:4], 0, atol=1e-7)
    assert np.abs(gradient).max() < 1e-5


def test_the_same_bits_twice(image_loss: ImageLoss) -> None:
    pair = structured_pair(131, 90)
    runs = []
    for other in (random_pair(150, 150), random_pair(20, 20)):
        record(image_loss, other, WEIGHTS["all"])  # leaves its own in the buffers
        runs.append([array.tobytes() for array in record(image_loss, pair, WEIGHTS["all"])])
    assert runs[0] == runs[1]


def test_a_term_of_weight_0_runs_no_passes(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    losses, names = ImageLoss(device), list[str]()
    dispatch = Commands.dispatch_grid
    monkeypatch.setattr(Commands, "dispatch_grid", lambda *a, **k: names.append(a[1].name) or dispatch(*a, **k))
    record(losses, random_pair(20, 20), WEIGHTS["l1"])
    assert names == ["loss_pixels", "loss_sums", "loss_gradient"]


# With the rasterizer


CORRECTION = torch.tensor([[0.9, 0.1, -0.05, 0.02], [0.03, 1.2, 0.0, -0.1], [-0.02, 0.05, 0.8, 0.2]])


@pytest.mark.parametrize(("antialiased", "corrected"), [(False, False), (True, False), (False, True)])
def test_a_step_is_that_of_the_rasterizer_and_the_references(
    device: Device, antialiased: bool, corrected: bool
) -> None:
    scene, other = (gaussians(antialiased=antialiased) for _ in range(2))
    mine, theirs = (CORRECTION.clone().requires_grad_() if corrected else None for _ in range(2))
    done = render_loss(scene, CAMERA, upload_rgba(device, TRUTH), BACKGROUND, WEIGHTS["all"], device, mine)
    done.loss.backward()
    drawn = rasterize(
        other.means, other.quats, other.scales, other.opacities, other.sh, CAMERA,
        sh_degree=1, background=BACKGROUND, antialiased=antialiased, depth=False, device=device,
    )  # fmt: skip
    truth = torch.from_numpy(TRUTH.astype(np.float32) / 255)
    shown = drawn.image.double() if theirs is None else loss_reference.exposure(drawn.image.double(), theirs.double())
    loss = total(shown, truth.double(), WEIGHTS["all"])
    loss.backward()
    assert done.loss.item() == pytest.approx(loss.item(), rel=1e-5)
    if theirs is not None:
        assert relative(mine.grad, theirs.grad) < 1e-4
    image = shown.detach()
    assert done.terms == pytest.approx(
        {
            "l1": loss_reference.l1(image, truth).item(),
            "mse": (image - truth).square().mean().item(),
            "ssim": 1 - image_metrics.ssim(image, truth.double()).item(),
            "pyramid": loss_reference.pyramid_loss(image, truth).item(),
            "ncc": loss_reference.ncc_loss(image, truth.double()).item(),
        },
        rel=1e-5,
    )
    assert torch.equal(done.radii, drawn.radii)
    assert torch.equal(done.means2d, drawn.means2d)
    expected = gradients(other, RenderLoss(loss, {}, drawn.radii, drawn.means2d))
    for name, gradient in gradients(scene, done).items():
        assert relative(gradient, expected[name]) < 1e-4, name


def test_the_upstream_gradient_scales(device: Device) -> None:
    scene, other = gaussians(), gaussians()
    done, again = step(device, scene), step(device, other)
    (3 * done.loss).backward()
    again.loss.backward()
    expected = gradients(other, again)
    for name, gradient in gradients(scene, done).items():
        torch.testing.assert_close(gradient, 3 * expected[name], msg=name)


def test_overflow_and_bands_do_not_show(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers that are too small at first; then so small a device that the image is drawn in bands."""
    results = []
    for capacity, most in ((1 << 16, 1 << 20), (16, 1 << 20), (400, 400)):
        rasterizer = Rasterizer(device, capacity=capacity)
        rasterizer.max_capacity = most
        monkeypatch.setattr(exchange_step, "rasterizer_of", lambda device, one=rasterizer: one)
        scene = gaussians(400)
        done = step(device, scene)
        done.loss.backward()
        results.append((rasterizer.plans.now.bands, done.loss.item(), gradients(scene, done)))
    bands, values, found = zip(*results, strict=True)
    assert bands[:2] == (1, 1)
    assert bands[2] > 1
    assert len(set(values)) == 1
    for name in found[0]:
        assert torch.equal(found[0][name], found[1][name]), name
        assert relative(found[2][name], found[0][name]) < 1e-5, name


def test_no_gaussians(device: Device) -> None:
    scene = gaussians(0)
    done = step(device, scene)
    done.loss.backward()
    image = BACKGROUND.double().expand(CAMERA.height, CAMERA.width, 3)
    truth = torch.from_numpy(TRUTH / 255)
    assert done.loss.item() == pytest.approx(total(image, truth, WEIGHTS["all"]).item(), rel=1e-5)
    assert scene.means.grad is not None
    assert scene.means.grad.shape == (0, 3)


def test_drawing_in_between_does_no_harm(device: Device) -> None:
    """`rasterize` and `render_loss` share their buffers."""

    def draw(scene: Gaussians) -> torch.Tensor:
        more = {"sh_degree": 1, "device": device}
        drawn = rasterize(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, CAMERA, **more)
        return drawn.image.square().mean()

    one, other = gaussians(), gaussians()
    loss = draw(one)
    step(device, gaussians(300)).loss.backward()
    loss.backward()
    draw(other).backward()
    assert one.means.grad is not None
    assert torch.equal(one.means.grad, other.means.grad)
