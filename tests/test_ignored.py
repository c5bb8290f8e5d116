"""Masks of a user's own in the training: what they cover has no influence."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import HEIGHT, WIDTH, write_colmap
from helpers.image_losses import BACKGROUND, CAMERA, TRUTH, WEIGHTS, gaussians, gradients
from helpers.loss_reference import total
from helpers.scenes import relative
from helpers.training import configure
from PIL import Image

from lapgs_wgpu import cli
from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.views import View, small_views
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.splat.rasterize import rasterize
from lapgs_wgpu.train.exchange_step import render_loss
from lapgs_wgpu.train.ground_truth import marked_pixels, upload_rgba
from lapgs_wgpu.train.run_folder import start_run_folder

IGNORED = np.zeros(TRUTH.shape[:2], np.bool_)
IGNORED[10:30, 20:45] = True
IGNORED[40, ::3] = True


@pytest.mark.kernels
@pytest.mark.parametrize("name", WEIGHTS)
def test_the_loss_is_that_of_an_image_with_the_truth_in_the_ignored_pixels(device: Device, name: str) -> None:
    scene, other = gaussians(), gaussians()
    view = View("train_000", CAMERA, 0.0, "made up", lambda: TRUTH, ignored=lambda: IGNORED)
    done = render_loss(
        scene, CAMERA, upload_rgba(device, marked_pixels(view, BACKGROUND)), BACKGROUND, WEIGHTS[name], device
    )
    done.loss.backward()
    drawn = rasterize(
        other.means, other.quats, other.scales, other.opacities, other.sh, CAMERA,
        sh_degree=1, background=BACKGROUND, depth=False, device=device,
    )  # fmt: skip
    shown = TRUTH.copy()
    shown[IGNORED] = (BACKGROUND.numpy() * 255 + 0.5).astype(np.uint8)
    truth = torch.from_numpy(shown.astype(np.float32) / 255).double()
    image = torch.where(torch.from_numpy(IGNORED)[..., None], truth, drawn.image.double())
    loss = total(image, truth, WEIGHTS[name])
    loss.backward()
    assert done.loss.item() == pytest.approx(loss.item(), rel=2e-5)
    assert relative(scene.means.grad, other.means.grad) < 1e-3
    assert relative(scene.sh.grad, other.sh.grad) < 1e-3
    assert all(bool(gradient.isfinite().all()) for gradient in gradients(scene, done).values())


def test_what_is_ignored_does_not_change_a_bit(device: Device, dataset: Dataset, tmp_path: Path) -> None:
    """Two captures that differ in ignored pixels alone train to the same bytes, discovery included."""

    def capture(level: int) -> Dataset:
        views = []
        for view in dataset.train:
            ignored = np.zeros((view.camera.height, view.camera.width), np.bool_)
            ignored[8:20, 12:30] = True
            pixels = view.load().copy()
            pixels[ignored] = level
            views.append(dataclasses.replace(view, load=pixels.copy, ignored=ignored.copy))
        return dataclasses.replace(dataset, train=tuple(views))

    config = configure(schedule__steps="8", schedule__warm_up="2", discovery__steps="8", discovery__size="32")
    for level in (10, 250):
        train(config, capture(level), tmp_path / str(level), device=device)
    train(config, dataset, tmp_path / "whole", device=device)
    one, two, whole = ((tmp_path / name / "checkpoint.ply").read_bytes() for name in ("10", "250", "whole"))
    assert one == two != whole


def test_small_views_ignore_what_any_of_their_pixels_ignores(dataset: Dataset) -> None:
    view = dataset.train[0]
    ignored = np.zeros((view.camera.height, view.camera.width), np.bool_)
    ignored[5, 7] = True
    (small,) = small_views([dataclasses.replace(view, ignored=ignored.copy)], view.camera.width // 2)
    assert np.argwhere(small.load_ignored()).tolist() == [[2, 3]]


@pytest.fixture
def masked(device: Device, tmp_path: Path) -> tuple[Path, Path]:
    """A capture, and a folder of masks of half its size, white in a corner."""
    capture, masks = tmp_path / "capture", tmp_path / "masks"
    write_colmap(capture, device)
    masks.mkdir()
    mask = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
    mask[:5, :7] = 255
    for image in (capture / "images").iterdir():
        Image.fromarray(mask).save(masks / f"{image.stem}.png")
    return capture, masks


def test_masks_of_a_folder(masked: tuple[Path, Path]) -> None:
    capture, masks = masked
    data = load_dataset(capture, masks=masks)
    assert all(view.ignored is None for view in data.test)
    for view in data.train:
        ignored = view.load_ignored()
        assert ignored is not None
        assert ignored.shape == (view.camera.height, view.camera.width)
        assert ignored[:10, :14].all()
        assert ignored.sum() == 140
    assert all(view.ignored is None for view in load_dataset(capture).train)


def test_any_color_is_white_enough(masked: tuple[Path, Path]) -> None:
    """Palettes give objects colors of their own."""
    capture, masks = masked
    for path in masks.iterdir():
        Image.new("RGB", (WIDTH, HEIGHT), (0, 128, 0)).save(path)
    Image.new("RGB", (WIDTH, HEIGHT), (0, 127, 0)).save(path)
    ignored = {Path(view.source).stem: view.load_ignored() for view in load_dataset(capture, masks=masks).train}
    assert {name for name, pixels in ignored.items() if pixels is not None and not pixels.any()} <= {path.stem}
    assert sum(pixels is not None and pixels.all() for pixels in ignored.values()) >= 4


def test_bad_masks_are_refused(masked: tuple[Path, Path], tmp_path: Path) -> None:
    capture, masks = masked
    trained = Path(load_dataset(capture).train[0].source)
    path = masks / f"{trained.stem}.png"
    Image.fromarray(np.zeros((30, 30), np.uint8)).save(path)
    with pytest.raises(InputError, match=rf"30x30 pixels, and the images are {WIDTH}x{HEIGHT}"):
        load_dataset(capture, masks=masks)
    path.unlink()
    with pytest.raises(InputError, match=rf"lacks 1 of \d+ masks.*{trained.name}"):
        load_dataset(capture, masks=masks)
    with pytest.raises(InputError, match="none"):
        load_dataset(capture, masks=tmp_path / "none")


@pytest.mark.nightly
def test_a_run_whose_masks_have_moved_is_resumed_and_evaluated(
    dataset: Dataset, data: Path, device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, run = tmp_path / "old", tmp_path / "new", tmp_path / "run"
    for path in (data / "train").glob("*.png"):
        (new / "train").mkdir(parents=True, exist_ok=True)
        Image.new("L", Image.open(path).size).save(new / "train" / path.name)
    run.mkdir()
    config = configure(data__path=str(data), data__masks=str(old), schedule__steps="3", schedule__save_interval="0")
    start_run_folder(run, config, device, dataset)
    assert cli.train_command(["--resume", str(run)]) == 2
    assert f"{old} is not a folder" in capsys.readouterr().err
    assert cli.train_command(["--resume", str(run), "--data.masks", str(new)]) == 0
    assert cli.train_command(["--eval", str(run)]) == 0
