"""The D-NeRF reader: geometry, sizes and times of what is right; one clear sentence for each thing that is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.dnerf_scene import FOV_X, HEIGHT, WIDTH, Scene, camera_to_world, make_scene
from PIL import Image

from lapgs_wgpu.data import composite, load_dataset
from lapgs_wgpu.errors import InputError

SHARED = Path(__file__).parents[2] / "shared" / "data"


def test_splits_names_times(tmp_path: Path) -> None:
    data = load_dataset(make_scene(tmp_path / "toy"))
    assert data.name == "toy"
    assert [view.name for view in data.train] == ["train_000", "train_001", "train_002"]
    assert [view.name for view in data.test] == ["test_000"]
    assert not {view.source for view in data.train} & {view.source for view in data.test}
    np.testing.assert_allclose(data.times, [1 / 6, 0.5, 5 / 6])
    assert data.test[0].time == 0.5


def test_extent_is_of_training_cameras(tmp_path: Path) -> None:
    data = load_dataset(make_scene(tmp_path / "toy"))
    centres = np.array([[4 * math.cos(i), 4 * math.sin(i), 0] for i in range(3)])
    expected = 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert data.extent == pytest.approx(expected, rel=1e-12)


def test_axes_and_field_of_view_of_wide_pictures(tmp_path: Path) -> None:
    """OpenGL's camera on the x axis: world y is to the right, z is up, and the horizontal angle spans the width."""
    camera = load_dataset(make_scene(tmp_path / "toy")).train[0].camera
    np.testing.assert_allclose(camera.position, [4, 0, 0], atol=1e-12)
    edge = 4 * math.tan(FOV_X / 2)
    for point, pixel in [
        ((0, 0, 0), (WIDTH / 2, HEIGHT / 2)),
        ((0, edge, 0), (WIDTH, HEIGHT / 2)),
        ((0, 0, edge), (WIDTH / 2, HEIGHT / 2 - WIDTH / 2)),  # square pixels: one focal length on both axes
    ]:
        p = camera.K @ (camera.T_cam_world @ [*point, 1])[:3]
        assert p[2] == pytest.approx(4)
        np.testing.assert_allclose(p[:2] / p[2], pixel, atol=1e-9)


def test_intrinsics_of_frames_and_file(tmp_path: Path) -> None:
    """A frame's own focal lengths and principal point, else those of the file, else the angle; all scaled from w, h."""

    def give(folder: Path, scene: Scene) -> None:
        scene["train"]["fl_y"] = 30.0
        scene["train"]["frames"][1].update(fl_x=20.0, fl_y=22.0, cx=5.0, cy=3.0)
        scene["train"]["frames"][2].update(fl_x=40.0, cx=11.0, cy=9.0, w=2 * WIDTH, h=2 * HEIGHT)

    first, second, third = (view.camera.K for view in load_dataset(make_scene(tmp_path / "toy", give)).train)
    focal = WIDTH / 2 / math.tan(FOV_X / 2)
    np.testing.assert_allclose(first, [[focal, 0, WIDTH / 2], [0, 30, HEIGHT / 2], [0, 0, 1]])
    np.testing.assert_allclose(second, [[20, 0, 5], [0, 22, 3], [0, 0, 1]])
    np.testing.assert_allclose(third, [[20, 0, 5.5], [0, 15, 4.5], [0, 0, 1]])


def test_lens_distortion_is_removed(tmp_path: Path) -> None:
    plain = load_dataset(make_scene(tmp_path / "plain")).train[1]
    bent = load_dataset(make_scene(tmp_path / "bent", frame_with(k1=-0.2))).train[1]
    assert bent.load().shape == plain.load().shape
    assert (bent.load() != plain.load()).any()
    np.testing.assert_array_equal(
        load_dataset(tmp_path / "bent").train[0].load(), load_dataset(tmp_path / "plain").train[0].load()
    )


def test_focal_lengths_need_no_angle(tmp_path: Path) -> None:
    def give(folder: Path, scene: Scene) -> None:
        for data in scene.values():
            del data["camera_angle_x"]
            data["fl_x"] = 17.0

    assert load_dataset(make_scene(tmp_path / "toy", give)).train[0].camera.K[1, 1] == pytest.approx(17.0)


def test_pixels_are_those_of_the_file(tmp_path: Path) -> None:
    view = load_dataset(make_scene(tmp_path / "toy")).train[1]
    pixels = view.load()
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels, np.asarray(Image.open(tmp_path / "toy/train/r_001.png")))


@pytest.mark.parametrize(("image_size", "size"), [(12, (12, 8)), (6, (6, 4)), (5, (5, 3)), (1, (1, 1))])
def test_shrinking_keeps_the_view(tmp_path: Path, image_size: int, size: tuple[int, int]) -> None:
    full = load_dataset(make_scene(tmp_path / "toy")).train[0]
    view = load_dataset(tmp_path / "toy", image_size=image_size).train[0]
    assert (view.camera.width, view.camera.height) == size
    assert view.load().shape == (size[1], size[0], 4)
    scale = np.array([size[0] / WIDTH, size[1] / HEIGHT, 1])
    np.testing.assert_allclose(view.camera.K, full.camera.K * scale[:, None])


def test_shrinking_averages_what_is_seen(tmp_path: Path) -> None:
    """Over any background, the shrunk picture is the mean of the pixels it replaces: premultiplied, no dark fringes."""
    make_scene(tmp_path / "toy")
    full = load_dataset(tmp_path / "toy").train
    half = load_dataset(tmp_path / "toy", image_size=WIDTH // 2).train
    for background in ((0, 0, 0), (1, 1, 1), (0.2, 0.9, 0.4)):
        for a, b in zip(full, half, strict=True):
            seen = composite(a.load(), background).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
            assert np.abs(composite(b.load(), background) - seen).max() < 3


def test_transparent_color_does_not_bleed(tmp_path: Path) -> None:
    def change(folder: Path, scene: Scene) -> None:
        pixels = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
        pixels[::2, ::2] = 255  # one opaque white pixel in four, the others transparent black
        Image.fromarray(pixels).save(folder / "train/r_000.png")

    pixels = load_dataset(make_scene(tmp_path / "toy", change), image_size=WIDTH // 2).train[0].load()
    np.testing.assert_array_equal(pixels, np.broadcast_to([255, 255, 255, 64], pixels.shape))


def test_pictures_without_transparency(tmp_path: Path) -> None:
    assert load_dataset(make_scene(tmp_path / "toy", mode="RGB")).train[0].load().shape == (HEIGHT, WIDTH, 3)


def test_times_left_out_are_even(tmp_path: Path) -> None:
    def change(folder: Path, scene: Scene) -> None:
        for data in scene.values():
            for frame in data["frames"]:
                del frame["time"]

    data = load_dataset(make_scene(tmp_path / "toy", change))
    assert [view.time for view in data.train] == [0, 0.5, 1]
    assert [view.time for view in data.test] == [0]


def test_file_path_may_carry_its_suffix(tmp_path: Path) -> None:
    def change(folder: Path, scene: Scene) -> None:
        for frame in scene["train"]["frames"]:
            frame["file_path"] += ".png"

    assert load_dataset(make_scene(tmp_path / "toy", change)).train[2].load().shape == (HEIGHT, WIDTH, 4)


def test_validation_views_are_optional(tmp_path: Path) -> None:
    def with_val(folder: Path, scene: Scene) -> None:
        scene["val"] = {**scene["test"], "frames": scene["test"]["frames"] * 2}

    dataset = load_dataset(make_scene(tmp_path / "with", with_val))
    assert [view.name for view in dataset.val] == ["val_000", "val_001"]
    assert (len(dataset.train), len(dataset.test), dataset.warnings) == (3, 1, load_dataset(tmp_path / "with").warnings)
    assert load_dataset(make_scene(tmp_path / "without")).val == ()


def test_validation_views_that_are_not_usable_are_left_out_with_a_warning(tmp_path: Path) -> None:
    folder = make_scene(tmp_path / "toy")
    (folder / "transforms_val.json").write_text("spoilt")
    dataset = load_dataset(folder)
    assert (len(dataset.train), dataset.val) == (3, ())
    assert any("validation views" in warning and "transforms_val.json" in warning for warning in dataset.warnings)


def test_validation_views_of_another_size_are_left_out_with_a_warning(tmp_path: Path) -> None:
    def with_val(folder: Path, scene: Scene) -> None:
        scene["val"] = {**scene["test"], "frames": [{**scene["test"]["frames"][0], "file_path": "./val"}]}
        Image.new("RGBA", (2 * WIDTH, 2 * HEIGHT)).save(folder / "val.png")

    dataset = load_dataset(make_scene(tmp_path / "toy", with_val))
    assert (len(dataset.train), dataset.val) == (3, ())
    (warning,) = (warning for warning in dataset.warnings if "validation views" in warning)
    assert f"{2 * WIDTH}x{2 * HEIGHT}" in warning
    assert f"is {WIDTH}x{HEIGHT}" in warning


def test_a_time_of_null_is_no_time(tmp_path: Path) -> None:
    """Of one frame, or it would get another one's."""
    with pytest.raises(InputError, match=r"transforms_train\.json, frame 1: time must be made of numbers, got null"):
        load_dataset(make_scene(tmp_path / "toy", lambda folder, scene: scene["train"]["frames"][1].update(time=None)))


def frame_with(**fields: Any) -> Callable[[Path, Scene], None]:
    """Give the second training frame other fields."""
    return lambda folder, scene: scene["train"]["frames"][1].update(fields)


def frame_without(field: str) -> Callable[[Path, Scene], None]:
    return lambda folder, scene: scene["train"]["frames"][1].pop(field)


def scene_with(**fields: Any) -> Callable[[Path, Scene], None]:
    return lambda folder, scene: scene["train"].update(fields)


def text_instead(text: str) -> Callable[[Path, Scene], None]:
    return lambda folder, scene: scene.update(train=text)


def matrix(row: int, column: int, value: Any) -> Callable[[Path, Scene], None]:
    rows = camera_to_world(1)
    rows[row][column] = value
    return frame_with(transform_matrix=rows)


def times_axes(factors: list[float]) -> Callable[[Path, Scene], None]:
    rows = np.array(camera_to_world(1))
    rows[:3, :3] *= factors
    return frame_with(transform_matrix=rows.tolist())


def sheared() -> Callable[[Path, Scene], None]:
    rows = np.array(camera_to_world(1))
    rows[:3, 0] = (rows[:3, 0] + 0.1 * rows[:3, 1]) / math.hypot(1, 0.1)
    return frame_with(transform_matrix=rows.tolist())


def other_size(folder: Path, scene: Scene) -> None:
    Image.new("RGBA", (10, 7)).save(folder / "test/r_000.png")


def cut(folder: Path, scene: Scene) -> None:
    path = folder / "train/r_001.png"
    path.write_bytes(path.read_bytes()[:-30])


def flip_a_bit(folder: Path, scene: Scene) -> None:
    path = folder / "train/r_001.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def picture_a_folder(folder: Path, scene: Scene) -> None:
    (folder / "train/r_001.png").unlink()
    (folder / "train/r_001.png").mkdir()


def no_picture(folder: Path, scene: Scene) -> None:
    (folder / "train/r_001.png").write_text("hello")


FRAME = ["transforms_train.json", "frame 1"]
PICTURE = ["r_001.png"]
BAD: dict[str, tuple[Callable[[Path, Scene], Any], list[str]]] = {
    "no training file": (lambda folder, scene: scene.pop("train"), ["transforms_train.json"]),
    "no test file": (lambda folder, scene: scene.pop("test"), ["transforms_test.json"]),
    "not JSON": (text_instead('{\n"camera_angle_x": 1,\n"frames": [}'), ["transforms_train.json"]),
    "empty file": (text_instead(""), ["transforms_train.json"]),
    "deep JSON": (text_instead("[" * 100_000), ["transforms_train.json"]),
    "huge integer": (text_instead('{"camera_angle_x": 1' + "0" * 5000 + "}"), ["transforms_train.json"]),
    "not an object": (text_instead("[1, 2]"), ["transforms_train.json"]),
    "no angle": (lambda folder, scene: scene["train"].pop("camera_angle_x"), ["camera_angle_x"]),
    "angle of text": (scene_with(camera_angle_x="wide"), ["camera_angle_x", '"wide"']),
    "angle in degrees": (scene_with(camera_angle_x=39.6), ["camera_angle_x", "radians", "39.6"]),
    "angle of zero": (scene_with(camera_angle_x=0), ["camera_angle_x"]),
    "angle of a denormal": (scene_with(camera_angle_x=1e-320), ["camera_angle_x"]),
    "no focal length": (scene_with(fl_x=0), ["transforms_train.json", "fl_x"]),
    "focal length of a frame": (frame_with(fl_x=1e9), [*FRAME, "fl_x"]),
    "principal point of text": (scene_with(cx="middle"), ["cx", '"middle"']),
    "fourth radial coefficient": (scene_with(k4=0.1), ["k4"]),
    "fisheye": (scene_with(camera_model="OPENCV_FISHEYE"), ["camera_model", "OPENCV_FISHEYE"]),
    "upright size of a wide picture": (scene_with(w=8, h=12), ["12x8", "8x12", "proportions"]),
    "angle of NaN": (scene_with(camera_angle_x=math.nan), ["camera_angle_x", "nan"]),
    "no frames": (lambda folder, scene: scene["train"].pop("frames"), ["frames"]),
    "empty frames": (scene_with(frames=[]), ["frames"]),
    "frames of text": (scene_with(frames="r_000"), ["frames", '"r_000"']),
    "frame of a number": (scene_with(frames=[3]), ["frame 0"]),
    "no file_path": (frame_without("file_path"), [*FRAME, "file_path"]),
    "file_path of a number": (frame_with(file_path=7), [*FRAME, "file_path"]),
    "file_path with a zero": (frame_with(file_path="a\0b"), [*FRAME, "file_path"]),
    "file_path too long": (frame_with(file_path="x" * 5000), [*FRAME]),
    "picture absent": (frame_with(file_path="./train/r_777"), ["r_777.png", *FRAME]),
    "picture a folder": (picture_a_folder, [*PICTURE, *FRAME]),
    "picture of text": (no_picture, [*PICTURE]),
    "picture cut short": (cut, [*PICTURE]),
    "picture with a wrong bit": (flip_a_bit, [*PICTURE]),
    "sizes mixed": (other_size, ["test/r_000.png", "10x7", "train/r_000.png", "12x8"]),
    "time of one frame missing": (frame_without("time"), [*FRAME, "time"]),
    "time above 1": (frame_with(time=1.5), [*FRAME, "time", "1.5"]),
    "time below 0": (frame_with(time=-0.01), [*FRAME, "time", "-0.01"]),
    "time of NaN": (frame_with(time=math.nan), [*FRAME, "time", "nan"]),
    "time of text": (frame_with(time="0.5"), [*FRAME, "time", '"0.5"']),
    "time of true": (frame_with(time=True), [*FRAME, "time", "true"]),
    "no matrix": (frame_without("transform_matrix"), [*FRAME, "transform_matrix"]),
    "matrix of 3 rows": (frame_with(transform_matrix=camera_to_world(1)[:3]), [*FRAME]),
    "matrix of ragged rows": (frame_with(transform_matrix=[[1]] * 4), [*FRAME, "transform_matrix"]),
    "matrix of text": (matrix(0, 3, "4"), [*FRAME, "transform_matrix", '"4"']),
    "matrix of null": (matrix(0, 3, None), [*FRAME, "transform_matrix", "null"]),
    "matrix with NaN": (matrix(2, 1, math.nan), [*FRAME, "transform_matrix", "nan"]),
    "matrix with infinity": (matrix(0, 3, math.inf), [*FRAME, "transform_matrix", "inf"]),
    "matrix with 1e300": (matrix(0, 0, 1e300), [*FRAME, "transform_matrix", "1e+300"]),
    "matrix with a huge integer": (matrix(0, 3, 10**400), [*FRAME, "transform_matrix"]),
    "matrix transposed": (frame_with(transform_matrix=np.transpose(camera_to_world(1)).tolist()), [*FRAME]),
    "matrix of zeros": (times_axes([0, 0, 0]), [*FRAME, "transform_matrix"]),
    "matrix scaled": (times_axes([2, 2, 2]), [*FRAME, "transform_matrix", "rotation"]),
    "matrix sheared": (sheared(), [*FRAME, "transform_matrix", "rotation", "0.0995"]),
    "matrix left-handed": (times_axes([1, 1, -1]), [*FRAME, "transform_matrix", "left-handed"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_scene_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    change, words = BAD[name]
    folder = make_scene(tmp_path / "toy", change)
    with pytest.raises(InputError) as caught:
        load_dataset(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    assert len(message) < 5500 if "long" in name else len(message) < 400
    for word in [str(folder), *words]:
        assert word in message


def test_smaller_pictures_are_not_enlarged(tmp_path: Path) -> None:
    camera = load_dataset(make_scene(tmp_path / "toy"), image_size=13).train[0].camera
    assert (camera.width, camera.height) == (12, 8)


def test_folder_missing_a_file_or_of_another_kind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere does not exist"):
        load_dataset(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is not a folder"):
        load_dataset(tmp_path / "file")
    make_scene(tmp_path / "scenes/hook")
    with pytest.raises(InputError, match=r"expected transforms_train\.json.*scenes hook"):
        load_dataset(tmp_path / "scenes")


def test_picture_lost_or_spoilt_after_opening_is_named(tmp_path: Path) -> None:
    views = load_dataset(make_scene(tmp_path / "toy")).train
    (tmp_path / "toy/train/r_000.png").unlink()
    cut(tmp_path / "toy", {})
    for view, file in zip(views, ("r_000.png", "r_001.png"), strict=False):
        with pytest.raises(InputError, match=rf"{file} cannot be decoded"):
            view.load()


@pytest.mark.parametrize("scene", ["dnerf/bouncingballs", "dnerf/hook", "dnerf/jumpingjacks", "rendered/swing"])
def test_published_scenes(scene: str) -> None:
    if not (SHARED / scene).is_dir():
        pytest.skip("scenes not at hand")
    data = load_dataset(SHARED / scene, image_size=200)
    assert len(data.train) == len(data.times) >= 100
    assert len(data.test) == 20
    assert (data.times[0], data.times[-1]) == (0, 1)
    assert 4 < data.extent < 8
    assert data.normalization is data.cloud is None
    for view in data.train + data.test:  # the cameras stand on a sphere about the origin and look at it
        assert np.linalg.norm(view.camera.position) == pytest.approx(4.03, abs=0.04)
        origin = view.camera.T_cam_world[:3, 3]
        np.testing.assert_allclose(origin[:2], 0, atol=1e-5)
        assert origin[2] > 0
    pixels = data.test[0].load()
    assert pixels.shape == (200, 200, 4)
    assert pixels[..., 3].max() == 255
    assert 0.02 < (pixels[..., 3] > 127).mean() < 0.8
