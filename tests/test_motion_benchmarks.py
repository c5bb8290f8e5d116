"""The scenes of benchmarks/motion_scenes, and the measures of what moves in them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import object_metrics
import pytest
from motion_scenes import MotionScene, moving_objects
from motion_writer import write_motion
from object_metrics import ObjectFrame, measure_object, object_truths, visible
from PIL import Image

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.views import composite
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.train.presets import load_config

pytestmark = pytest.mark.nightly


def test_masks_and_clean_plates_match_the_images(tmp_path: Path) -> None:
    """An image differs from an object's clean plate inside the mask alone."""
    folder = write_motion(tmp_path / "scene", MotionScene(background="room"), size=64, train_times=2, test_views=4)
    for index, view in enumerate(load_dataset(folder).test):
        for name in ("ball", "box"):
            mask, clean = (
                np.asarray(Image.open(folder / f"{part}/test/r_{index:03d}_{name}.png")) for part in ("masks", "clean")
            )
            differs = (view.load() != clean).any(axis=2)
            assert not differs[mask == 0].any()
            assert differs[mask == 255].mean() > 0.9


def frames_of(folder: Path, draw: Any) -> list[ObjectFrame]:
    """Measure what `draw(clean, color, alpha, diameter)` makes of each visible object of the test views."""
    views, found = load_dataset(folder).test, []
    for view, objects in zip(views, object_truths(folder, "test", views), strict=True):
        masks = {one.name: one.mask() for one in objects}
        for one in objects:
            if visible(masks[one.name], one.diameter):
                clean, alpha = composite(one.clean(), np.zeros(3)).astype(float), masks[one.name][..., None] / 255
                truth = composite(view.load(), np.zeros(3))
                image = draw(clean, truth - clean * (1 - alpha), alpha, one.diameter).clip(0, 255).round()
                others = np.any([mask > 0 for name, mask in masks.items() if name != one.name], axis=0)
                args = (truth, clean.astype(np.uint8), masks[one.name], others, one.diameter)
                found.append(measure_object(one.name, image.astype(np.uint8), *args))
    return found


def test_the_measures_know_the_answer(tmp_path: Path) -> None:
    folder = write_motion(tmp_path / "scene", MotionScene(), size=100, train_times=4, test_views=4)
    exact = frames_of(folder, lambda clean, color, alpha, d: color + clean * (1 - alpha))
    assert len(exact) >= 5
    assert min(frame.iou for frame in exact) > 0.88
    assert max(frame.distance or 0 for frame in exact) < 0.05
    missing = frames_of(folder, lambda clean, color, alpha, d: clean)
    assert {(frame.iou, frame.distance) for frame in missing} == {(0.0, None)}
    ghost = frames_of(folder, lambda clean, color, alpha, d: 0.4 * color + clean * (1 - 0.4 * alpha))
    assert max(frame.iou for frame in ghost) < 0.1
    shifted = frames_of(
        folder,
        lambda clean, color, alpha, d: np.roll(color, round(d / 2), 0) + clean * (1 - np.roll(alpha, round(d / 2), 0)),
    )
    assert max(frame.iou for frame in shifted) < 0.5
    assert np.median([frame.distance for frame in shifted if frame.distance]) == pytest.approx(0.5, abs=0.1)


def test_a_run_is_measured(tmp_path: Path, device: Device) -> None:
    folder = write_motion(tmp_path / "scene", MotionScene(path=4), size=32, train_times=4, test_views=2)
    given = {"data.path": str(folder), "schedule.steps": 2, "points.count": 50, "field.width": 8}
    train(load_config("tiny", given), load_dataset(folder), tmp_path / "run", device=device)
    record = json.loads((folder / "objects.json").read_text())
    assert [one["moves"] for one in record["objects"]] == [True, True, False]
    figures = object_metrics.measure_run(tmp_path / "run")
    assert figures.psnr > 0
    assert figures.found == 0


def test_turns_and_swaps_are_seen_in_paths() -> None:
    objects = [one for one in moving_objects(MotionScene(objects="twins", turns=2)) if one.moves]
    times = np.linspace(0, 1, 21)
    arms = np.random.default_rng(0).uniform(-0.15, 0.15, (30, 3))
    turning = [np.stack([arms @ one.turn(t).T for t in times]) + one.positions(times)[:, None] for one in objects]
    still = [arms + one.positions(times)[:, None] for one in objects]
    assert object_metrics.turns_and_swaps(np.concatenate(turning, axis=1), objects, times) == (1.0, 0)
    assert object_metrics.turns_and_swaps(np.concatenate([turning[0], still[1]], axis=1), objects, times)[0] < 0.7
    swapped = np.concatenate([np.where(times[:, None, None] > 0.8, turning[1 - n], turning[n]) for n in (0, 1)], axis=1)
    assert object_metrics.turns_and_swaps(swapped, objects, times)[1] == 2
