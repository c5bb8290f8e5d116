"""Motion masks of captures of which nothing but the images is known, and what the evaluation makes of them."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lapgs_wgpu import cli
from lapgs_wgpu.data import View, load_dataset
from lapgs_wgpu.data.motion_scenes import MotionScene
from lapgs_wgpu.data.motion_writer import write_motion
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.evaluate import evaluate, to_8_bit, write_metrics
from lapgs_wgpu.train.motion_masks import LEAST_TIMES, differs_from_median, differs_from_static, still_backgrounds

CAMERA = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=24, height=16)
FAST = ["--steps", "20", "--schedule.warm_up", "5", "--points.count", "100", "--data.size", "0"]


def clip(count: int, camera: Camera = CAMERA) -> list[View]:
    """A white square that travels over grey, two pixels a view."""
    views = []
    for index in range(count):
        image = np.full((16, 24, 3), 90, np.uint8)
        image[4:8, 2 * index : 2 * index + 2] = 255
        views.append(View(f"v{index}", camera, index / count, "v", image.copy))
    return views


def test_the_median_of_a_still_camera_is_the_background() -> None:
    views = clip(8)
    backgrounds = still_backgrounds(views, View.load)
    assert all((background == 90).all() for background in backgrounds if background is not None)
    assert len([background for background in backgrounds if background is not None]) == 8
    mask = differs_from_median(views[3].load(), np.full((16, 24, 3), 90, np.uint8))
    assert np.argwhere(mask).min(axis=0).tolist() == [4, 6]
    assert mask.sum() == 8


def test_cameras_that_move_or_see_few_times_have_no_median() -> None:
    other = Camera.looking_at([1, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=24, height=16)
    views = [*clip(LEAST_TIMES), *clip(LEAST_TIMES - 1, other)]
    known = [background is not None for background in still_backgrounds(views, View.load)]
    assert known == [True] * LEAST_TIMES + [False] * (LEAST_TIMES - 1)
    same_time = [dataclasses.replace(view, time=0.5) for view in clip(LEAST_TIMES)]
    assert still_backgrounds(same_time, View.load) == [None] * LEAST_TIMES


def test_small_differences_are_no_motion() -> None:
    image = np.full((16, 24, 3), 90, np.uint8)
    assert not differs_from_median(image + np.uint8(16), image).any()
    assert differs_from_median(image + np.uint8(17), image).all()


def test_the_residual_of_a_static_fit_is_averaged() -> None:
    """Edges that are a pixel off cancel; a region that differs does not."""
    stripes = np.zeros((16, 24, 3), np.uint8)
    stripes[:, ::2] = 60
    assert not differs_from_static(stripes, 60 - stripes)[:, 3:-3].any()
    image = np.full((16, 24, 3), 90, np.uint8)
    moved = image.copy()
    moved[4:12, 4:12] = 200
    mask = differs_from_static(moved, image)
    assert mask[4:12, 4:12].all()
    assert mask.sum() < 12 * 12 + 1


@pytest.fixture(scope="module")
def scene(device: Device) -> Scene4D:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    colors = np.random.default_rng(1).uniform(0, 1, (40, 3))
    return Scene4D.from_points(points, colors, np.full(40, 0.1), FieldConfig(kind="static"), device=device)


def test_the_evaluation_of_a_still_camera_reports_its_moving_pixels(scene: Scene4D, tmp_path: Path) -> None:
    drawn = to_8_bit(scene.render(CAMERA, 0.5).image)
    views = []
    for index in range(6):
        image = drawn.copy()
        image[2:5, 3 * index : 3 * index + 2] ^= 128  # moves, and is not in the rendering
        views.append(View(f"v{index}", CAMERA, index / 6, "v", image.copy))
    metrics = evaluate(scene, views, "black")
    assert metrics["motion"] == "median of the clip"
    assert metrics["psnr_moving"] == pytest.approx(-20 * np.log10(128 / 255))
    assert metrics["psnr_still"] == 100
    assert "found" not in metrics
    write_metrics(tmp_path, metrics)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = [float(row["psnr_moving"]) for row in csv.DictReader(file)]
    assert rows == pytest.approx([metrics["psnr_moving"]] * 6)
    assert "psnr_moving" not in evaluate(scene, views[:3], "black")
    with_static = evaluate(scene, views[:3], "black", static=scene)
    assert with_static["motion"] == "static fit"
    assert with_static["psnr_moving"] < 20
    assert "psnr_moving" not in evaluate(
        scene, [dataclasses.replace(views[0], pixels=drawn.copy)], "black", static=scene
    )


@pytest.mark.nightly
def test_a_motion_scene_from_training_to_metrics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_motion(tmp_path / "scene", MotionScene(camera="still"), size=48, train_times=5, test_views=5)

    def train(name: str, *options: str) -> dict[str, Any]:
        assert cli.train_command(["tiny", "--data", str(data), "--out", str(tmp_path / name), *FAST, *options]) == 0
        return json.loads((tmp_path / name / "metrics.json").read_text())

    metrics = train("static", "--field", "static")
    assert sorted(metrics["objects"]) == ["ball", "box"]
    assert 0 <= metrics["found"] <= 1
    assert metrics["psnr_moving"] < metrics["psnr"]
    assert len(metrics["objects"]["box"]["views"]) == 5
    train("moving", "--field", "mlp", "--field.width", "8")

    (data / "objects.json").unlink()  # as a capture of which nothing is known
    evaluation = ["--eval", str(tmp_path / "moving"), "--motion-from"]
    assert cli.train_command([*evaluation, str(tmp_path / "static")]) == 0
    again = json.loads((tmp_path / "moving" / "metrics.json").read_text())
    assert again["motion"] == "static fit"
    assert again["psnr_moving"] < again["psnr_still"]
    assert "objects" not in again

    capsys.readouterr()
    for run, problem in (("moving", "has the field mlp; --motion-from needs"), ("nowhere", "does not exist")):
        assert cli.train_command([*evaluation, str(tmp_path / run)]) == 2
        assert problem in capsys.readouterr().err
    options = ["tiny", "--data", str(data), "--out", str(tmp_path / "new"), "--motion-from", str(tmp_path / "static")]
    assert cli.train_command(options) == 2
    assert "--motion-from goes with --eval RUN" in capsys.readouterr().err


def test_loading_does_not_need_the_truth(tmp_path: Path) -> None:
    data = write_motion(tmp_path / "scene", MotionScene(), size=16, train_times=2, test_views=2)
    before = load_dataset(data).fingerprint
    (data / "objects.json").unlink()
    dataset = load_dataset(data)
    assert dataset.fingerprint == before
    assert all(view.objects == () for view in dataset.test)
