"""The pipeline from a reader's frames to a dataset: what every format gets without any code of its own."""

from pathlib import Path

import numpy as np
import pytest
from helpers.captures import HEIGHT, WIDTH, cameras

from lapgs_wgpu.data import Dataset, load, load_dataset
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import ImageFile, check_image, decode, encode_png
from lapgs_wgpu.data.lens import Lens, Undistortion
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

COUNT = 6


def lens_of(camera: Camera, k1: float) -> Lens:
    K = camera.K
    return Lens(WIDTH, HEIGHT, K[0, 0], K[1, 1], K[0, 2], K[1, 2], radial=(k1, 0.0, 0.0))


def read(folder: Path, image_size: int | None) -> Capture:
    """A format of images alone: poses on an arc, one lens with distortion, times by the file names."""
    frames = []
    lens = lens_of(cameras(1)[0], 0.1)
    for file, camera in zip(sorted(folder.glob("*.png")), cameras(COUNT), strict=True):
        frames.append(Frame(check_image(file), lens, camera.T_cam_world, str(file), ImageName(file.name)))
    return Capture(frames, folder)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture in a format that one reader and one entry in the list add."""
    monkeypatch.setattr(
        load, "READERS", (*load.READERS, Reader("arc", "arc.txt", lambda f: (f / "arc.txt").is_file(), read))
    )
    rng = np.random.default_rng(0)
    for i in range(COUNT):
        image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        (tmp_path / f"{10 * i}.png".zfill(7)).write_bytes(encode_png(image))
    (tmp_path / "arc.txt").write_text("")
    return tmp_path


def test_a_new_reader_gets_everything_else(folder: Path) -> None:
    data: Dataset = load_dataset(folder, image_size=WIDTH // 2)
    assert [view.time for view in data.train] == [0, 0.2, 0.4, 0.6, 1]
    assert [Path(view.source).name for view in data.test] == ["040.png"]
    assert [view.name for view in data.train][-1] == "train_00004"
    assert data.normalization is not None
    assert data.depths is not None
    camera = data.train[0].camera
    assert (camera.width, camera.height) == (WIDTH // 2, HEIGHT // 2)
    assert camera.K[0, 0] > cameras(1)[0].K[0, 0] / 2, "undistorting zooms in"
    np.testing.assert_allclose(camera.position, data.normalization.points(cameras(COUNT)[0].position), atol=1e-9)
    assert data.train[0].load().shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_undistorting_leaves_the_color_of_transparent_pixels_behind() -> None:
    """A white disk on black that is transparent: all that is left of it is white."""
    lens = lens_of(cameras(1)[0], -0.2)
    undistortion = Undistortion(lens, lens.pinhole("here"))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    disk = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) < HEIGHT / 3
    image = np.where(disk[..., None], 255, 0).astype(np.uint8).repeat(4, axis=2)
    straight = undistortion.apply(image)
    alpha = straight[..., 3]
    assert ((alpha > 0) & (alpha < 255)).sum() > 50
    assert (straight[alpha > 0] >= 254)[:, :3].all()
    np.testing.assert_array_equal(alpha, undistortion.apply(image[..., :3])[..., 0])


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 3), (2, 4, 4), (1, 1, 3)])
def test_png_keeps_every_bit(shape: tuple[int, ...], tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(image))
    expected = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    np.testing.assert_array_equal(decode(tmp_path / "a.png"), expected)
    assert check_image(tmp_path / "a.png") == ImageFile(tmp_path / "a.png", (shape[1], shape[0]), alpha=shape[-1] == 4)


@pytest.mark.parametrize(("name", "what"), [("walk/IMG_1.JPG", "images"), ("walk.mp4", "films")])
def test_what_has_no_poses_is_for_lapgs_prepare(name: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=f"it holds {what} without poses, which lapgs-prepare finds"):
        load_dataset(tmp_path)
