"""The measure of moving objects, on renderings of which the answer is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import affine_transform, gaussian_filter, shift

from lapgs_wgpu.data import View, load_dataset
from lapgs_wgpu.data.motion_scenes import MotionScene
from lapgs_wgpu.data.motion_writer import write_motion
from lapgs_wgpu.data.objects import ObjectTruth
from lapgs_wgpu.data.views import composite
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.train.object_metrics import (
    NOT_FOUND,
    ObjectFrame,
    measure_object,
    measure_objects,
    psnr_within,
    summarise,
    visible,
)

WHITE = np.ones(3)
BACKGROUNDS = {
    "black": MotionScene(path=2),
    "white": MotionScene(path=4),
    "room": MotionScene(path=2, background="room"),
}


@pytest.fixture(scope="module", params=BACKGROUNDS)
def views(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[tuple[View, ...], np.ndarray]:
    folder = tmp_path_factory.mktemp("scene") / "scene"
    write_motion(folder, BACKGROUNDS[request.param], size=100, train_times=4, test_views=4)
    return load_dataset(folder).test, WHITE * (request.param == "white")


def layers(view: View, one: ObjectTruth, background: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The view without the object (H, W, 3), the object premultiplied (H, W, 3) and its opacity (H, W, 1)."""
    clean = composite(one.clean(), background).astype(float)
    alpha = one.mask()[..., None] / 255
    return clean, composite(view.load(), background) - clean * (1 - alpha), alpha


def over(clean: np.ndarray, color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.clip(color + clean * (1 - alpha), 0, 255).round().astype(np.uint8)


def moved(planes: np.ndarray, rows: float, columns: float) -> np.ndarray:
    return shift(planes, (rows, columns, 0), order=1)


def enlarged(planes: np.ndarray, centre: np.ndarray, scale: float) -> np.ndarray:
    offset = [*(centre - centre / scale), 0]
    return affine_transform(planes, [1 / scale, 1 / scale, 1], offset, order=1)


def frames_of(views: tuple[tuple[View, ...], np.ndarray], draw: Any) -> list[ObjectFrame]:
    """Measure what `draw(clean, color, alpha, diameter)` makes of each visible object."""
    found = []
    for view in views[0]:
        masks = {one.name: one.mask() for one in view.objects}
        for one in view.objects:
            if visible(masks[one.name], one.diameter):
                clean, color, alpha = layers(view, one, views[1])
                others = np.any([mask > 0 for name, mask in masks.items() if name != one.name], axis=0)
                truth = over(clean, color, alpha)
                image = draw(clean, color, alpha, one.diameter)
                plate = clean.astype(np.uint8)
                found.append(measure_object(one.name, image, truth, plate, masks[one.name], others, one.diameter))
    assert len(found) >= 5
    return found


def distances(frames: list[ObjectFrame]) -> list[float | None]:
    return [frame.distance for frame in frames]


def test_the_truth_itself_is_found_exactly(views: Any) -> None:
    frames = frames_of(views, lambda clean, color, alpha, d: over(clean, color, alpha))
    assert min(frame.iou for frame in frames) > 0.88
    assert max(frame.distance or 0 for frame in frames) < 0.05
    assert {frame.psnr for frame in frames} == {100.0}


def test_a_missing_object_is_not_found(views: Any) -> None:
    frames = frames_of(views, lambda clean, color, alpha, d: clean.astype(np.uint8))
    assert {frame.iou for frame in frames} == {0.0}
    assert set(distances(frames)) == {None}
    assert max(frame.psnr for frame in frames) < 16


def test_a_ghost_is_not_found(views: Any) -> None:
    frames = frames_of(views, lambda clean, color, alpha, d: over(clean, 0.4 * color, 0.4 * alpha))
    assert max(frame.iou for frame in frames) < 0.1


def test_blur_of_the_background_is_no_object(views: Any) -> None:
    frames = frames_of(views, lambda clean, color, alpha, d: gaussian_filter(clean, (3, 3, 0)).astype(np.uint8))
    assert max(frame.iou for frame in frames) < 0.1


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_shifted_object_is_not_found_and_its_distance_is_known(views: Any, share: float) -> None:
    def draw(clean: np.ndarray, color: np.ndarray, alpha: np.ndarray, d: float) -> np.ndarray:
        return over(clean, moved(color, share * d, 0), moved(alpha, share * d, 0))

    frames = frames_of(views, draw)
    assert max(frame.iou for frame in frames) < 0.5
    assert np.median([frame.distance for frame in frames if frame.distance is not None]) == pytest.approx(
        share, abs=0.1
    )


def test_a_slightly_shifted_or_enlarged_object_is_found(views: Any) -> None:
    def near(clean: np.ndarray, color: np.ndarray, alpha: np.ndarray, d: float) -> np.ndarray:
        return over(clean, moved(color, 0, 0.15 * d), moved(alpha, 0, 0.15 * d))

    def larger(clean: np.ndarray, color: np.ndarray, alpha: np.ndarray, d: float, scale: float = 1.25) -> np.ndarray:
        centre = np.stack(np.nonzero(alpha[..., 0] > 0.5)).mean(axis=1)
        return over(clean, enlarged(color, centre, scale), enlarged(alpha, centre, scale))

    assert np.mean([frame.iou >= 0.5 for frame in frames_of(views, near)]) > 0.85
    assert np.mean([frame.iou >= 0.5 for frame in frames_of(views, larger)]) > 0.85
    twice = frames_of(views, lambda *layers: larger(*layers, scale=2.0))
    assert max(frame.iou for frame in twice) < 0.4
    assert max(frame.distance or 0 for frame in twice) < 0.35


def test_soft_and_wrongly_textured_objects_are_found(views: Any) -> None:
    soft = frames_of(views, lambda c, p, a, d: gaussian_filter(over(c, p, a).astype(float), (1, 1, 0)).astype(np.uint8))
    plain = frames_of(views, lambda c, p, a, d: over(c, a * p.sum((0, 1)) / a.sum(), a))
    for frames in (soft, plain):
        assert np.mean([frame.iou >= 0.5 for frame in frames]) > 0.9
        assert max(frame.psnr for frame in frames) < 30


def square(size: int, at: tuple[int, int], color: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    image = np.zeros((40, 40, 3), np.uint8)
    mask = np.zeros((40, 40), np.uint8)
    rows, columns = slice(at[0], at[0] + size), slice(at[1], at[1] + size)
    image[rows, columns], mask[rows, columns] = color, 255
    return image, mask


def truth_of(name: str, mask: np.ndarray, clean: np.ndarray) -> ObjectTruth:
    return ObjectTruth(name, np.zeros(2), 10.0, lambda: mask, lambda: clean)


def test_another_moving_object_is_not_claimed() -> None:
    (a, mask_a), (b, mask_b) = square(8, (10, 10), (200, 40, 40)), square(8, (10, 19), (40, 60, 200))
    objects = [truth_of("a", mask_a, b), truth_of("b", mask_b, a)]
    exact = measure_objects(a + b, a + b, objects, np.zeros(3))
    assert [(frame.name, frame.iou, frame.distance) for frame in exact] == [("a", 1, 0), ("b", 1, 0)]
    swapped, _ = square(8, (10, 19), (200, 40, 40))
    alone = measure_objects(swapped, a + b, objects, np.zeros(3))
    assert [frame.iou for frame in alone] == [0, 0]


def test_hardly_visible_objects_do_not_count() -> None:
    image, mask = square(4, (10, 10), (200, 40, 40))
    assert measure_objects(image, image, [truth_of("a", mask, 0 * image)], np.zeros(3)) == []
    assert visible(mask, 4.0) is False  # 16 pixels
    assert visible(square(6, (10, 10), (1, 1, 1))[1], 14.0) is False  # of 154
    assert visible(square(6, (10, 10), (1, 1, 1))[1], 7.0) is True


def test_psnr_within_written_out() -> None:
    image, truth = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3), np.uint8)
    truth[0, 0] = 51
    pixels = np.zeros((4, 4), bool)
    pixels[0, :2] = True
    assert psnr_within(image, truth, pixels) == pytest.approx(-10 * np.log10(0.2**2 / 2))
    assert psnr_within(image, truth, ~pixels) == 100.0


def test_summary_over_frames_and_objects() -> None:
    frames = [
        [ObjectFrame("a", 20.0, 0.9, 0.1), ObjectFrame("b", 10.0, 0.0, None)],
        [ObjectFrame("a", 30.0, 0.5, 0.3)],
        [ObjectFrame("a", 28.0, 0.4, None)],
    ]
    entries: Any = summarise(frames, ["x", "y", "z"])
    a, b = entries["objects"]["a"], entries["objects"]["b"]
    assert (a["psnr_moving"], a["found"], a["track_error"]) == (26, pytest.approx(2 / 3), 0.3)
    assert (b["psnr_moving"], b["found"], b["track_error"]) == (10, 0, NOT_FOUND)
    assert [row["view"] for row in a["views"]] == ["x", "y", "z"]
    assert (entries["psnr_moving"], entries["found"]) == (18, pytest.approx(1 / 3))
    assert entries["track_error"] == NOT_FOUND
    assert summarise([[], []], ["x", "y"]) == {}
    json.dumps(entries, allow_nan=False)


# objects.json as a file of strangers


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_motion(tmp_path / "scene", MotionScene(), size=24, train_times=2, test_views=2)


def test_the_truth_fits_pictures_that_are_shrunk(scene: Path) -> None:
    whole, half = load_dataset(scene), load_dataset(scene, image_size=12)
    assert [one.name for one in whole.test[0].objects] == ["ball", "box"]
    assert all(view.objects == () for view in whole.train)
    for large, small in zip(whole.test, half.test, strict=True):
        for a, b in zip(large.objects, small.objects, strict=True):
            assert b.diameter == pytest.approx(a.diameter / 2)
            np.testing.assert_allclose(b.centre, a.centre / 2)
            assert b.mask().shape == (12, 12)
            assert b.clean().shape == (12, 12, 4)


BROKEN: dict[str, tuple[Any, str]] = {
    "no list": (lambda record: record.update(objects=3), "objects must be a list, got 3"),
    "no objects": (lambda record: record.pop("objects"), "has no field objects"),
    "no object": (lambda record: record["objects"].insert(0, 7), "object 0 must be a JSON object, got 7"),
    "path as name": (lambda record: record["objects"][0].update(name="../x"), "object 0: name must be letters"),
    "diameter": (lambda record: record["objects"][1].update(diameter=0), "object 1: diameter must be above 0"),
    "positions": (lambda record: record["objects"][1].update(positions=[]), "object 1, positions has no field test"),
    "too few": (lambda record: record["objects"][0]["positions"]["test"].pop(), r"positions\.test must be a list of 2"),
    "no vector": (lambda record: record["objects"][0]["positions"].update(test=[1, 2]), "must be a list of 3 numbers"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_record_is_refused_in_one_sentence(name: str, scene: Path) -> None:
    record = json.loads((scene / "objects.json").read_text())
    BROKEN[name][0](record)
    (scene / "objects.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=BROKEN[name][1]):
        load_dataset(scene)


def test_missing_and_damaged_masks_are_named(scene: Path) -> None:
    mask = scene / "masks/test/r_001_box.png"
    mask.write_bytes(b"no picture")
    with pytest.raises(InputError, match="r_001_box"):
        load_dataset(scene)
    mask.unlink()
    with pytest.raises(InputError, match=r"r_001_box\.png does not exist"):
        load_dataset(scene)


def test_the_masks_are_antialiased(scene: Path) -> None:
    mask = np.asarray(Image.open(scene / "masks/test/r_000_box.png"))
    assert len(np.unique(mask)) > 3
