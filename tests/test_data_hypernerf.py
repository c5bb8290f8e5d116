"""The reader of nerfies' layout: what its cameras see is what the pictures show; one sentence for what is wrong."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.captures import HEIGHT, WIDTH, Blobs, Change, agreement, bright, write_nerfies, write_points
from PIL import Image
from scipy.ndimage import binary_erosion

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.open_dataset import open_dataset
from lapgs_wgpu.train.presets import load_config

SHARED = Path(__file__).parents[2] / "shared" / "data"
ID = "left_000001"
TEST_ID = "left_000004"

LENSES: dict[str, dict[str, Any]] = {
    "principal point": {"principal_point": [WIDTH / 2 + 7, HEIGHT / 2 - 5]},
    "skew": {"skew": 6.0},
    "pixel aspect ratio": {"pixel_aspect_ratio": 1.2},
    "radial": {"radial_distortion": [0.3, -0.2, 0.1]},
    "barrel": {"radial_distortion": [-0.3, 0.05, 0.0]},
    "tangential": {"tangential_distortion": [0.05, -0.03]},
    "all": {
        "principal_point": [WIDTH / 2 + 3, HEIGHT / 2 + 2],
        "skew": -2.0,
        "radial_distortion": [0.2, -0.1, 0.02],
        "tangential_distortion": [-0.02, 0.03],
    },
}


@pytest.fixture(scope="module")
def template(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good capture; tests copy it."""
    return write_nerfies(tmp_path_factory.mktemp("template") / "toy", device)


@pytest.fixture
def toy(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "toy"))


def edit(path: Path, **fields: Any) -> None:
    """Other values in a JSON file; None removes a field."""
    data = json.loads(path.read_text()) | fields
    path.write_text(json.dumps({name: value for name, value in data.items() if value is not None}))


def test_cameras_see_what_the_pictures_show(toy: Path, device: Device) -> None:
    """Axes, scale, centre: the only difference left is the rounding of both sides."""
    assert agreement(load_dataset(toy), Blobs.random(), device) > 50


@pytest.mark.parametrize("name", LENSES)
def test_lenses_are_honoured(name: str, device: Device, tmp_path: Path) -> None:
    data = load_dataset(write_nerfies(tmp_path / "toy", device, count=3, lens=LENSES[name]))
    assert agreement(data, Blobs.random(), device, [0, 2]) > 33
    assert all(view.camera.K[0, 1] == 0 for view in data.train)


def test_a_bent_picture_keeps_its_size_and_loses_as_little_as_can_be(device: Device, tmp_path: Path) -> None:
    focal = {}
    for name in ("radial", "barrel"):
        data = load_dataset(write_nerfies(tmp_path / name, device, count=3, lens=LENSES[name]))
        camera = data.train[0].camera
        assert data.train[0].load().shape == (HEIGHT, WIDTH, 3)
        focal[name] = camera.K[0, 0] * math.tan(0.45) / (WIDTH / 2)
    assert focal["barrel"] == pytest.approx(1)  # the picture shows more than its frame: nothing is missing
    assert 1 < focal["radial"] < 1.2


def test_lenses_are_ignored_as_published_where_asked(device: Device, tmp_path: Path) -> None:
    folder = write_nerfies(tmp_path / "toy", device, count=3, lens=LENSES["all"])
    plain, honoured = load_dataset(folder, undistort=False), load_dataset(folder)
    for view, other in zip(plain.train, honoured.train, strict=True):
        K = view.camera.K
        assert (K[0, 2], K[1, 2], K[0, 1]) == (WIDTH / 2, HEIGHT / 2, 0)
        assert K[0, 0] * math.tan(0.45) == pytest.approx(WIDTH / 2)
        file = Path(view.source)
        np.testing.assert_array_equal(view.load(), np.asarray(Image.open(file)))
        assert not np.array_equal(view.load(), other.load())
    config = load_config("hypernerf-broom", {"data.path": str(folder), "data.size": 0})
    assert np.array_equal(open_dataset(config).train[0].camera.K, plain.train[0].camera.K)


def test_a_straight_picture_is_not_touched(toy: Path) -> None:
    view = load_dataset(toy).train[1]
    np.testing.assert_array_equal(view.load(), np.asarray(Image.open(toy / f"rgb/1x/{ID}.png")))


def test_splits_of_a_validation_rig(toy: Path) -> None:
    data = load_dataset(toy)
    assert [Path(view.source).stem for view in data.train] == [f"left_{i:06d}" for i in range(4)]
    assert [Path(view.source).stem for view in data.test] == ["left_000004"]
    assert [view.name for view in (*data.train[:1], *data.test)] == ["train_000", "test_000"]


@pytest.mark.parametrize("empty", [None, []])
def test_splits_of_interpolation(empty: Any, device: Device, tmp_path: Path) -> None:
    """Without val_ids every fourth frame is trained on, and those halfway between are tested."""
    toy = write_nerfies(tmp_path / "toy", device, count=9)
    edit(toy / "dataset.json", val_ids=empty)
    data = load_dataset(toy)
    assert [int(Path(view.source).stem[-3:]) for view in data.train] == [0, 4, 8]
    assert [int(Path(view.source).stem[-3:]) for view in data.test] == [2, 6]
    assert [view.time for view in data.test] == [2 / 8, 6 / 8]


def test_times_are_those_of_time_id_then_warp_id(toy: Path) -> None:
    assert [view.time for view in load_dataset(toy).train] == [0, 0.25, 0.5, 0.75]
    path = toy / "metadata.json"
    entries = json.loads(path.read_text())
    for i, entry in enumerate(entries.values()):
        entry["time_id"] = [3, 3, 5, 7, 11][i]  # a rig: two pictures at a time
    path.write_text(json.dumps(entries))
    data = load_dataset(toy)
    assert [view.time for view in (*data.train, *data.test)] == [0, 0, 0.25, 0.5, 1]


@pytest.mark.parametrize(
    ("wanted", "folder", "width"),
    [(None, "1x", 64), (200, "1x", 64), (64, "1x", 64), (63, "1x", 63), (33, "1x", 33), (32, "2x", 32), (16, "2x", 16)],
)  # fmt: skip
def test_the_folder_suits_the_wanted_size(
    wanted: int | None, folder: str, width: int, toy: Path, device: Device
) -> None:
    data = load_dataset(toy, image_size=wanted)
    view = data.train[0]
    assert Path(view.source).parent.name == folder
    assert (view.camera.width, view.load().shape[1]) == (width, width)
    assert agreement(data, Blobs.random(), device) > 20  # small pictures are averaged, and drawn with a dilation


def test_cloud_and_cameras_are_moved_alike(toy: Path) -> None:
    data = load_dataset(toy)
    assert data.cloud is not None
    assert data.normalization is not None
    means = Blobs.random().means.double().numpy()
    np.testing.assert_allclose(data.cloud.points, data.normalization.points(means), atol=1e-5)
    assert (data.cloud.colors == 0.5).all()
    raw = json.loads((toy / f"camera/{ID}.json").read_text())["position"]
    np.testing.assert_allclose(data.train[1].camera.position, data.normalization.points(np.array(raw)), atol=1e-9)
    assert np.abs(data.cloud.points).max() == pytest.approx(1.3, rel=0.1)


def test_without_a_cloud_the_views_fill_the_box(toy: Path, device: Device) -> None:
    (toy / "points.npy").unlink()
    data = load_dataset(toy)
    assert data.cloud is None
    assert data.depths is not None
    assert data.normalization is not None
    np.testing.assert_allclose(np.array(data.depths) / data.normalization.scale, [2, 8])
    assert np.linalg.norm(data.focus) < 1.3
    assert agreement(data, Blobs.random(), device) > 50


def test_a_ply_cloud_is_in_the_coordinates_of_the_camera_files(toy: Path) -> None:
    with_npy = load_dataset(toy).cloud
    (toy / "points.npy").unlink()
    write_points(toy / "points3D_downsample2.ply", Blobs.random().means.numpy(), np.full((40, 3), 51))
    cloud = load_dataset(toy).cloud
    assert cloud is not None
    assert with_npy is not None
    np.testing.assert_allclose(cloud.points, with_npy.points, atol=1e-5)
    np.testing.assert_allclose(cloud.colors, 0.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: (p - [0.5, -1.0, 0.25]) * 0.2 + [40, 0, 0], ["see 0 %", "50 %", "radius", "away from it"]),
        (lambda p: p * 1e3, ["% of its points", "other coordinates"]),
        (lambda p: p * 1e-4 + [0.3, -0.2, 0.5], ["speck", "radius of", "stand"]),
    ],
)
def test_a_cloud_in_other_coordinates_is_refused(change: Any, words: list[str], toy: Path) -> None:
    np.save(toy / "points.npy", change(Blobs.random().means.double().numpy()))
    with pytest.raises(InputError) as caught:
        load_dataset(toy)
    for word in ["points.npy", *words]:
        assert word in str(caught.value)


def mask_of(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file).convert("L")) == 255


@pytest.mark.parametrize(("size", "factor"), [(None, 1), (32, 2)])
def test_masks_come_from_the_folder_of_the_pictures_factor(size: int | None, factor: int, toy: Path) -> None:
    data = load_dataset(toy, image_size=size)
    mask = data.test[0].load_mask()
    assert mask is not None
    np.testing.assert_array_equal(mask, mask_of(toy / f"covisible/{factor}x/val/{TEST_ID}.png"))
    np.testing.assert_array_equal(mask, bright(data.test[0].load()))
    assert 0.1 < mask.mean() < 0.9
    assert [view.mask for view in data.train] == [None] * 4


def test_a_mask_of_another_factor_is_enlarged(toy: Path) -> None:
    shutil.rmtree(toy / "covisible/1x/val")
    small = mask_of(toy / f"covisible/2x/val/{TEST_ID}.png")
    mask = load_dataset(toy).test[0].load_mask()
    np.testing.assert_array_equal(mask, small.repeat(2, axis=0).repeat(2, axis=1))


def test_a_pixel_is_measured_where_all_that_it_is_made_of_is_white(toy: Path) -> None:
    shutil.rmtree(toy / "rgb/2x")
    large = mask_of(toy / f"covisible/1x/val/{TEST_ID}.png")
    mask = load_dataset(toy, image_size=32).test[0].load_mask()
    np.testing.assert_array_equal(mask, large.reshape(24, 2, 32, 2).all(axis=(1, 3)))


def test_rigs_whose_cameras_take_turns_have_masks_of_their_own(toy: Path) -> None:
    (toy / "covisible/1x/val").rename(toy / "covisible/1x/val_intl")
    mask = load_dataset(toy).test[0].load_mask()
    np.testing.assert_array_equal(mask, mask_of(toy / f"covisible/1x/val_intl/{TEST_ID}.png"))


@pytest.mark.parametrize("name", LENSES)
def test_masks_are_straightened_as_the_pictures_are(name: str, device: Device, tmp_path: Path) -> None:
    toy = write_nerfies(tmp_path / "toy", device, count=3, lens=LENSES[name])
    view = load_dataset(toy).test[0]
    mask, seen = view.load_mask(), bright(view.load())
    assert mask is not None
    assert not (mask & ~seen).any()
    assert not (binary_erosion(seen, iterations=2) & ~mask).any()  # at edges, all of what a pixel mixes must be white


def test_captures_without_masks_have_none(toy: Path) -> None:
    shutil.rmtree(toy / "covisible")
    assert load_dataset(toy).test[0].load_mask() is None
    (toy / "covisible/1x/val").mkdir(parents=True)
    Image.new("L", (WIDTH, HEIGHT)).save(toy / f"covisible/1x/val/{ID}.png")  # of no test picture
    assert load_dataset(toy).test[0].load_mask() is None


def json_file(name: str, **fields: Any) -> Change:
    return lambda folder, _: edit(folder / f"{name}.json", **fields)


def text(name: str, content: str) -> Change:
    return lambda folder, _: (folder / name).write_text(content)


def gone(name: str) -> Change:
    def change(folder: Path, _: Any) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def entry(**fields: Any) -> Change:
    """Another metadata entry of the second id."""

    def change(folder: Path, _: Any) -> None:
        path = folder / "metadata.json"
        data = json.loads(path.read_text())
        data[ID] = {key: value for key, value in (data[ID] | fields).items() if value is not None}
        path.write_text(json.dumps(data))

    return change


def picture(size: tuple[int, int], mode: str = "RGB", file: str = f"rgb/1x/{ID}.png") -> Change:
    return lambda folder, _: Image.new(mode, size).save(folder / file)


def array(name: str, value: Any) -> Change:
    return lambda folder, _: np.save(folder / name, value)


CAMERA = f"camera/{ID}"
MASK = f"covisible/1x/val/{TEST_ID}.png"
BAD: dict[str, tuple[Change, list[str]]] = {
    "no scene": (gone("scene.json"), ["scene.json"]),
    "no metadata": (gone("metadata.json"), ["metadata.json"]),
    "no camera": (gone(f"{CAMERA}.json"), [f"{CAMERA}.json"]),
    "no pictures": (gone("rgb"), ["rgb"]),
    "picture absent": (gone(f"rgb/1x/{ID}.png"), [f"rgb/1x/{ID}.png", "dataset.json"]),
    "not JSON": (text("dataset.json", "{"), ["dataset.json"]),
    "a list": (text("dataset.json", "[1]"), ["dataset.json"]),
    "no ids": (json_file("dataset", ids=None), ["dataset.json", "ids"]),
    "ids of numbers": (json_file("dataset", ids=[1, 2]), ["dataset.json", "ids"]),
    "an id as a path": (json_file("dataset", ids=["../../x"]), ["dataset.json", "ids", "../../x"]),
    "an id twice": (json_file("dataset", ids=["a", "a"]), ["dataset.json"]),
    "unknown id": (json_file("dataset", train_ids=["x"]), ["train_ids"]),
    "trained on the test": (json_file("dataset", val_ids=[ID]), ["train_ids", ID]),
    "no training ids": (json_file("dataset", train_ids=[]), ["train_ids"]),
    "no scale": (json_file("scene", scale=None), ["scene.json", "scale"]),
    "scale 0": (json_file("scene", scale=0), ["scene.json", "scale"]),
    "scale NaN": (json_file("scene", scale=math.nan), ["scene.json", "scale", "nan"]),
    "center of 2": (json_file("scene", center=[0, 0]), ["scene.json", "center"]),
    "near beyond far": (json_file("scene", near=9, far=2), ["scene.json", "near", "far"]),
    "entry missing": (json_file("metadata", **{ID: None}), ["metadata.json", ID]),
    "no warp_id": (entry(warp_id=None), ["metadata.json", ID, "warp_id"]),
    "one time_id": (entry(time_id=4), ["metadata.json", "time_id"]),
    "warp_id of text": (entry(warp_id="4"), ["metadata.json", ID, "warp_id", '"4"']),
    "warp_id below 0": (entry(warp_id=-4), ["metadata.json", ID, "warp_id", "-4"]),
    "no orientation": (json_file(CAMERA, orientation=None), [f"{CAMERA}.json", "orientation"]),
    "orientation of 2 rows": (json_file(CAMERA, orientation=[[1, 0, 0]] * 2), ["orientation"]),
    "orientation scaled": (json_file(CAMERA, orientation=(2 * np.eye(3)).tolist()), ["orientation"]),
    "orientation mirrored": (json_file(CAMERA, orientation=np.diag([1, 1, -1]).tolist()), ["left-handed"]),
    "position of text": (json_file(CAMERA, position=[0, 0, "1"]), ["position", '"1"']),
    "position far": (json_file(CAMERA, position=[0, 0, 1e12]), ["position", "1e+12", "1e+09"]),
    "focal length huge": (json_file(CAMERA, focal_length=1e9), [CAMERA, "focal_length", "0.05"]),
    "focal length 0": (json_file(CAMERA, focal_length=0), ["focal_length"]),
    "aspect 0": (json_file(CAMERA, pixel_aspect_ratio=0), ["pixel_aspect_ratio"]),
    "principal point NaN": (json_file(CAMERA, principal_point=[math.nan, 0]), ["principal_point", "nan"]),
    "2 radial": (json_file(CAMERA, radial_distortion=[0, 0]), ["radial_distortion"]),
    "wild lens": (json_file(CAMERA, radial_distortion=[900, 0, 0]), [f"{CAMERA}.json", "radial_distortion"]),
    "lens that folds": (json_file(CAMERA, radial_distortion=[-90, 0, 0]), ["radial_distortion"]),
    "image size": (json_file(CAMERA, image_size=[0, 48]), ["image_size", "got 0"]),
    "other proportions": (json_file(CAMERA, image_size=[64, 64]), ["rgb/1x", "64x48", "64x64", f"{CAMERA}.json"]),
    "sizes mixed": (picture((32, 24)), [f"{ID}.png", "32x24", "64x48"]),
    "picture of text": (text(f"rgb/1x/{ID}.png", "hello"), [f"{ID}.png"]),
    "mask absent": (
        json_file("dataset", train_ids=["left_000000"], val_ids=[ID, TEST_ID]),
        [f"covisible/1x/val/{ID}.png does not exist", "remove"],
    ),
    "mask of text": (text(MASK, "hello"), [MASK]),
    "mask of other proportions": (picture((64, 64), "L", MASK), [MASK, "64x64", "64x48", f"camera/{TEST_ID}.json"]),
    "mask of 16 bit": (picture((64, 48), "I;16", MASK), [MASK]),
    "mask of nothing": (picture((64, 48), "L", MASK), [MASK, "remove"]),
    "points of text": (text("points.npy", "hello"), ["points.npy"]),
    "points of objects": (array("points.npy", np.array([{}])), ["points.npy"]),
    "points of 2": (array("points.npy", np.zeros((5, 2))), ["points.npy"]),
    "no points": (array("points.npy", np.zeros((0, 3))), ["points.npy"]),
    "points NaN": (array("points.npy", np.full((5, 3), np.nan)), ["points.npy"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_capture_is_refused_in_one_sentence(name: str, toy: Path) -> None:
    change, words = BAD[name]
    change(toy, {})
    with pytest.raises(InputError) as caught:
        load_dataset(toy)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    assert len(message) < 500
    for word in [str(toy), *words]:
        assert word in message


def test_a_picture_exchanged_after_opening_is_named(toy: Path) -> None:
    view = load_dataset(toy).train[1]
    picture((32, 24))(toy, {})
    with pytest.raises(InputError, match=rf"{ID}\.png.*32x24.*64x48"):
        view.load()


def test_a_real_capture() -> None:
    folder = SHARED / "hypernerf/hand"
    if not folder.is_dir():
        pytest.skip("scenes not at hand")
    data = load_dataset(folder, image_size=256)
    assert (len(data.train), len(data.test)) == (75, 11)
    assert Path(data.test[0].source).parent.name == "2x"
    assert data.cloud is not None
    assert np.linalg.norm(data.focus) < 1.3
    assert np.abs(np.percentile(data.cloud.points, [1, 99], axis=0)).max() == pytest.approx(1.3, abs=1e-3)
    assert data.test[0].load().shape == (192, 256, 3)
