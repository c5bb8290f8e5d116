"""The D-NeRF reader: geometry, intrinsics, transparency and validation views. See also test_data_refusals.py."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.damaged_captures import put
from helpers.dnerf_scene import FOV_X, HEIGHT, WIDTH, Scene, make_scene
from PIL import Image

from lapgs_wgpu.data import composite, load_dataset


def test_splits_names_times(tmp_path: Path) -> None:
    data = load_dataset(make_scene(tmp_path / "toy"))
    assert data.name == "toy"
    assert [view.name for view in data.train] == ["train_000", "train_001", "train_002"]
    assert [view.name for view in data.test] == ["test_000"]
    np.testing.assert_allclose(data.times, [1 / 6, 0.5, 5 / 6])
    assert data.test[0].time == 0.5
    centres = np.array([[4 * math.cos(i), 4 * math.sin(i), 0] for i in range(3)])
    expected = 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert data.extent == pytest.approx(expected, rel=1e-12)
    pixels = data.train[1].load()
    np.testing.assert_array_equal(pixels, np.asarray(Image.open(tmp_path / "toy/train/r_001.png")))


def test_axes_and_field_of_view_of_wide_images(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(("image_size", "size"), [(13, (12, 8)), (12, (12, 8)), (5, (5, 3)), (1, (1, 1))])
def test_shrinking_keeps_the_view(tmp_path: Path, image_size: int, size: tuple[int, int]) -> None:
    """Smaller images are not enlarged."""
    full = load_dataset(make_scene(tmp_path / "toy")).train[0]
    view = load_dataset(tmp_path / "toy", image_size=image_size).train[0]
    assert (view.camera.width, view.camera.height) == size
    assert view.load().shape == (size[1], size[0], 4)
    scale = np.array([size[0] / WIDTH, size[1] / HEIGHT, 1])
    np.testing.assert_allclose(view.camera.K, full.camera.K * scale[:, None])


def test_shrinking_averages_what_is_seen(tmp_path: Path) -> None:
    """Over any background, the shrunk image is the mean of the pixels it replaces: premultiplied, no dark fringes."""
    folder = make_scene(tmp_path / "toy")
    pixels = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    pixels[::2, ::2] = 255  # one opaque white pixel in four, the others transparent black
    Image.fromarray(pixels).save(folder / "train/r_000.png")
    full, half = load_dataset(folder).train, load_dataset(folder, image_size=WIDTH // 2).train
    np.testing.assert_array_equal(half[0].load(), np.broadcast_to([255, 255, 255, 64], half[0].load().shape))
    for background in ((0, 0, 0), (1, 1, 1), (0.2, 0.9, 0.4)):
        for a, b in zip(full, half, strict=True):
            seen = composite(a.load(), background).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
            assert np.abs(composite(b.load(), background) - seen).max() < 3


def test_what_a_file_may_leave_out(tmp_path: Path) -> None:
    """Transparency, times, which are even then, and the angle beside a focal length; the suffix may be there."""

    def change(folder: Path, scene: Scene) -> None:
        for data in scene.values():
            del data["camera_angle_x"]
            data["fl_x"] = 17.0
            for frame in data["frames"]:
                del frame["time"]
        scene["train"]["frames"][2]["file_path"] += ".png"

    data = load_dataset(make_scene(tmp_path / "toy", change, mode="RGB"))
    assert data.train[2].load().shape == (HEIGHT, WIDTH, 3)
    assert [view.time for view in data.train] == [0, 0.5, 1]
    assert data.train[0].camera.K[1, 1] == pytest.approx(17.0)


def test_validation_views_are_optional(tmp_path: Path) -> None:
    """What is not usable is left out with a warning."""
    folder = make_scene(tmp_path / "toy")
    before = load_dataset(folder)
    assert before.val == ()
    validation = json.loads((folder / "transforms_test.json").read_text())
    (folder / "transforms_val.json").write_text(json.dumps({**validation, "frames": validation["frames"] * 2}))
    data = load_dataset(folder)
    assert [view.name for view in data.val] == ["val_000", "val_001"]
    assert (len(data.train), len(data.test), data.warnings) == (3, 1, before.warnings)
    Image.new("RGBA", (2 * WIDTH, 2 * HEIGHT)).save(folder / "val.png")
    put("transforms_val.json", "frames", 1, "file_path", "./val")(folder)
    for _ in range(2):
        data = load_dataset(folder)
        assert (len(data.train), data.val) == (3, ())
        assert any("transforms_val.json" in warning or "val.png" in warning for warning in data.warnings)
        (folder / "transforms_val.json").write_text("spoilt")
