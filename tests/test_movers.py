"""Movers that masks show: cut-outs that are followed, and the cube in which things move."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import bright, write_colmap, write_rig
from helpers.films import Board, drawn, room_cloud, walk
from PIL import Image
from scipy import ndimage

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.placement import mover_cube
from lapgs_wgpu.data.views import View, composite, small_views
from lapgs_wgpu.discovery.cutouts import cutout_tracks
from lapgs_wgpu.discovery.discover import Found, scene_with, start_training
from lapgs_wgpu.discovery.field_fit import fit_field
from lapgs_wgpu.discovery.residual import Residual
from lapgs_wgpu.discovery.static_fit import depth_of, static_fit
from lapgs_wgpu.discovery.tracks import Tracks
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D, isotropic_rows
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.evaluate import evaluate
from lapgs_wgpu.train.presets import load_config

BOARD = Board(0.4, 0.6, 0.7)
CAMERAS = walk(10, 128, 96)
TIMES = [i / (len(CAMERAS) - 1) for i in range(len(CAMERAS))]
TAKEN = [drawn(camera, t, BOARD) for camera, t in zip(CAMERAS, TIMES, strict=True)]
FAR = 5.0  # depth of what stands still


def followed(chosen: Sequence[int], hidden: float, repainted: int = 99) -> tuple[Tracks | None, float]:
    """hidden: the depth of what the board hides. repainted: the image from which on the board has other colors."""
    residuals, depths = [], []
    for i in chosen:
        image, mask = TAKEN[i]
        unit = (image / 255).astype(np.float32)
        unit[mask] = abs(unit[mask] - (i >= repainted))
        residuals.append(Residual(CAMERAS[i], TIMES[i], unit, unit, mask))
        depths.append(np.where(mask, hidden, FAR).astype(np.float32))
    return cutout_tracks(residuals, depths, 1.3)


@pytest.mark.parametrize(("hidden", "nearest"), [(FAR + 1, FAR), (FAR - 1, FAR - 1)], ids=["ground", "hidden"])
def test_cutouts_show_what_moves_where_it_is_in_each_image(hidden: float, nearest: float) -> None:
    tracks, share = followed(range(len(TAKEN)), hidden)
    assert tracks is not None
    assert share > 0.9
    for i, (camera, (image, mask)) in enumerate(zip(CAMERAS, TAKEN, strict=True)):
        seen = tracks.supported[i]
        pixels, depth = camera.project(tracks.paths[i, seen])
        assert depth == pytest.approx(0.9 * nearest, abs=1e-3)
        x, y = pixels.astype(int).clip(0, [[127, 95]]).T
        assert mask[y, x].mean() > 0.9
        shown = np.zeros_like(mask)
        shown[y, x] = True
        assert np.abs(image[y, x] / 255 - tracks.colors[seen]).mean() < 0.06
        assert shown[mask].mean() > 0.4  # no more than a point a pixel


def test_cutouts_go_on_where_the_images_have_a_gap() -> None:
    chosen = [0, 1, 2, 7, 8, 9]
    tracks, _ = followed(chosen, FAR, repainted=7)
    assert tracks is not None
    assert tracks.parts == 2
    for i, number in enumerate(chosen):
        middle = np.argwhere(TAKEN[number][1]).mean(axis=0)[::-1]
        for k in range(tracks.parts):
            pixels, _ = CAMERAS[number].project(tracks.paths[i, tracks.part == k])
            assert pixels.mean(axis=0) == pytest.approx(middle, abs=20)


def test_a_cutout_bends() -> None:
    """A band whose middle sways beside its ends; affine maps would miss the rows by up to 2 pixels."""
    rows, columns = np.mgrid[:96, :128].astype(np.float64)
    colors = np.random.default_rng(4).uniform(0.2, 0.9, (16, 8, 3))
    camera, times = CAMERAS[0], np.linspace(0, 1, 9)
    residuals = []
    for t in times:
        across, down = columns - 40 - sway(rows, t), rows - 18
        mask = (across >= 0) & (across < 30) & (down >= 0) & (down < 60)
        at = [down[mask] / 60 * 15, across[mask] / 30 * 7]
        image = np.full((96, 128, 3), 0.5, np.float32)
        image[mask] = np.stack([ndimage.map_coordinates(colors[..., i], at, order=1) for i in range(3)], axis=1)
        residuals.append(Residual(camera, float(t), image, np.full_like(image, 0.5), mask))
    tracks, share = cutout_tracks(residuals, [np.full((96, 128), FAR, np.float32)] * len(times), 1.3)
    assert tracks is not None
    assert tracks.parts == 1
    assert share > 0.95
    places = np.stack([camera.project(path)[0] - 0.5 for path in tracks.paths])
    start = places[0, :, 0] - sway(places[0, :, 1], 0.0)
    off = [at[:, 0] - start - sway(at[:, 1], float(t)) for t, at in zip(times, places, strict=True)]
    assert np.abs(off).mean() < 0.4


def sway(rows: np.ndarray, t: float) -> np.ndarray:
    """Pixels to the right."""
    return 8 * t * np.sin(np.pi * (rows - 18) / 60)


def test_sheets_are_shown_one_after_another(device: Device) -> None:
    times, parts = np.linspace(0, 1, 40), 20
    number = np.repeat(np.arange(parts), 10)
    supported = np.arange(40)[:, None] // 2 == number
    draw = np.random.default_rng(5)
    positions = draw.uniform(-0.3, 0.3, (len(number), 3)).astype(np.float32)
    paths = positions + 0.2 * np.sin(6 * times)[:, None, None].astype(np.float32)
    tracks = Tracks(positions, draw.uniform(0, 1, (len(number), 3)).astype(np.float32), number, paths, supported)
    config, generator = load_config("film", {"points.count": "100"}), torch.Generator().manual_seed(0)
    rows = isotropic_rows(np.full((100, 3), 0.9, np.float32), np.zeros((100, 3), np.float32), np.full(100, 0.1), 0.5)
    static = Scene4D(rows, load_config("film", {"field.kind": "static"}).field, device)
    scene = scene_with(Found(static, tracks, times, 1.0, "", {}, sheets=True), config, generator, None)
    assert fit_field(scene, tracks, times, 400, generator, lambda step: None, fades=True, light={}) is not None
    shown = np.stack([scene.at(t).opacities.detach().numpy()[100:] for t in times])
    assert np.median(shown[supported]) > 0.8
    assert np.median(shown[3:][supported[:-3]]) < 0.15
    assert np.median(shown[:-3][supported[3:]]) < 0.15


def test_what_is_far_behind_a_gap_adds_little_to_a_depth(device: Device) -> None:
    camera = Camera.looking_at([0, 0, 0], [0, 0, 1], up=[0, -1, 0], fov_x=0.8, width=33, height=25)
    means, opacities = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 40.0]]), torch.tensor([0.9, 0.95])
    rows = {
        "means": means,
        "log_scales": means[:, 2:].log().expand(-1, 3).contiguous(),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        "opacity_logits": opacities.logit(),
        "sh_dc": torch.zeros(2, 1, 3),
        "sh_rest": torch.zeros(2, 15, 3),
    }
    scene = Scene4D(rows, load_config("film", {"field.kind": "static"}).field, device)
    first, second = 0.9, 0.1 * 0.95
    depth = (first + second) / (first / 2 + second / 40)  # 2.2; the mean of the depths is 5.6
    assert depth_of(scene, camera)[12, 16] == pytest.approx(depth, rel=1e-3)
    assert np.isnan(depth_of(scene, dataclasses.replace(camera, near=50.0))).all()


def test_masks_are_completed_by_what_differs_beside_them() -> None:
    still, taken = np.full((2, 96, 128, 3), 0.5, np.float32)
    taken[20:80, 30:60] = taken[10:30, 100:120] = 1.0
    told, whole = np.zeros((2, 96, 128), bool)
    told[20:50, 30:60] = whole[20:80, 30:60] = True  # half of one thing, and nothing of the other
    np.testing.assert_array_equal(Residual(CAMERAS[0], 0.0, taken, still, told).mask, whole)


def test_the_cube_of_movers_holds_them_and_not_the_room() -> None:
    points, colors = room_cloud(400, 0.0)

    def view(camera: Camera, mask: np.ndarray) -> View:
        return View("", camera, 0.0, "", dict, moving=lambda: mask)

    seen = [view(camera, mask) for camera, (_, mask) in zip(CAMERAS, TAKEN, strict=True)]
    cube = mover_cube(Cloud(points, colors.astype(np.float32)), seen)
    assert cube is not None
    room = np.ptp(points, axis=0).max() / 2
    assert 0.4 < cube.half < 0.8 * room
    empty = view(CAMERAS[0], np.zeros((96, 128), bool))
    assert mover_cube(Cloud(points, colors.astype(np.float32)), [empty]) is None


NEARLY, RIM = 200, 6  # level of masks of nearly everything; rows at the upper rim that stand still
QUICK = {"discovery.steps": "10", "discovery.field_steps": "5", "discovery.size": "64", "points.count": "300"}


def change_images(files: list[Path], change: Callable[[int, np.ndarray], np.ndarray]) -> None:
    for i, file in enumerate(files):
        with Image.open(file) as image:
            pixels = np.asarray(image.convert("RGB"))
        Image.fromarray(change(i, pixels).astype(np.uint8)).save(file)


def write_masks(capture: Path, level: int | None) -> None:
    """Masks of a capture: of one level, NEARLY but for the upper rim, or white where something bright is shown."""
    (capture / "masks").mkdir(exist_ok=True)
    for file in sorted((capture / "images").glob("*.png")):
        with Image.open(file) as image:
            shown = bright(np.asarray(image)) if level is None else np.full(image.size[::-1], level > 0)
            shown[: RIM if level == NEARLY else 0] = False
        Image.fromarray(shown.astype(np.uint8) * 255).save(capture / "masks" / file.name)


def sky(_: int, pixels: np.ndarray) -> np.ndarray:
    height = len(pixels)
    return np.where((np.arange(height) < 0.6 * height)[:, None, None], [150, 190, 240], pixels)


@pytest.mark.parametrize(
    ("change", "level", "told", "field"),
    [
        (lambda i, pixels: pixels, 0, "nothing moves by the masks", "laplacian"),
        (sky, None, "", "laplacian"),
        (lambda i, pixels: pixels * (0.4 if i % 2 else 1.0), None, "", "grid4d"),
        (lambda i, pixels: np.roll(pixels, 3 * i, axis=1), NEARLY, "", "laplacian"),
    ],
    ids=["a room without movers", "sky over more than half", "exposure that jumps", "waves"],
)
def test_a_hard_film_trains(
    change: Callable[[int, np.ndarray], np.ndarray],
    level: int | None,
    told: str,
    field: str,
    tmp_path: Path,
    device: Device,
) -> None:
    capture = write_colmap(tmp_path / "film", device)
    write_masks(capture, level)
    change_images(sorted((capture / "images").glob("*.png")), change)
    steps = {"data.path": str(capture), "schedule.steps": "15", "field.kind": field}
    config = load_config("film", QUICK | steps)
    with start_training(config, device=device) as training:
        assert training.discovery is not None
        assert ("nothing is added" in training.discovery) == (level == 0)
        assert any(told in warning for warning in ["", *training.dataset.warnings])
        losses = [training.step().loss for _ in range(3)]
        measured = evaluate(training.scene, training.dataset.test, "black")
    assert np.isfinite(losses).all()
    assert 3 < measured["psnr"] < 60
    assert (measured["psnr_moving"] == "not available") == (level == 0)


def test_a_black_camera_of_a_rig_is_told(tmp_path: Path, device: Device) -> None:
    capture = write_rig(tmp_path / "rig", device)
    assert not any("are black" in warning for warning in load_dataset(capture).warnings)
    change_images(sorted((capture / "images" / "cam02").glob("*.png")), lambda i, pixels: pixels * 0)
    assert any("1 of 4 cameras are black, such as cam02" in warning for warning in load_dataset(capture).warnings)


def test_a_film_starts_from_its_masks(tmp_path: Path, device: Device) -> None:
    capture = write_colmap(tmp_path / "film", device)
    write_masks(capture, 255)
    with pytest.raises(InputError, match="everything moves"):
        load_dataset(capture, movers="masks")
    write_masks(capture, 0)
    assert any("nothing moves" in warning for warning in load_dataset(capture, movers="masks").warnings)
    write_masks(capture, None)
    changes = {"data.path": str(capture), "density.limit": "500", "schedule.steps": "20"}
    with start_training(load_config("film", changes | QUICK), device=device) as training:
        assert training.discovery is not None
        assert "moving parts" in training.discovery
        assert all(view.moving is not None for view in (*training.dataset.train, *training.dataset.test))
        assert training.step().step == 1
        images = static_fit(training.config, training.dataset, device, lambda step: None).images
        views = small_views(training.dataset.train, 64)
        for image, view in zip(images, sorted(views, key=lambda view: view.time), strict=True):
            assert image.mask.any()
            assert image.image == pytest.approx(composite(view.load(), np.zeros(3)) / 255, abs=1e-6)
