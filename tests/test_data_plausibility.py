"""Captures that contradict themselves, or lie far from their origin: read right, or told."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.captures import cameras, write_model, write_points
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.images import gray_thumbnail
from lapgs_wgpu.data.normalize import BOX, Normalization
from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.errors import InputError

WIDTH, HEIGHT, COUNT = 64, 48, 8
UTM = np.array([448262.0, 5411932.0, 120.0])
MIDDLE = np.array([0.3, -0.2, 0.5])  # what the cameras look at
CAMERAS = cameras(COUNT, WIDTH, HEIGHT)
RNG = np.random.default_rng(0)
PICTURE = RNG.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
Write = Callable[[NDArray[np.uint8], Path], None]


def as_png(image: NDArray[np.uint8], path: Path) -> None:
    Image.fromarray(image).save(path)


def capture(
    folder: Path,
    write: Write = as_png,
    *,
    suffix: str = "png",
    size: tuple[int, int] = (WIDTH, HEIGHT),
    offset: NDArray[np.float64] | float = 0.0,
    digits: int = 17,
    mask: Write | None = None,
    **fields: Any,
) -> Path:
    """transforms.json of COUNT cameras, whose images hold one picture."""
    (folder / "images").mkdir(parents=True)
    K = CAMERAS[0].K
    data = {"w": size[0], "h": size[1], "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": size[0] / 2, "cy": size[1] / 2} | fields
    frames: list[dict[str, Any]] = []
    for i, camera in enumerate(CAMERAS):
        write(PICTURE, folder / f"images/{i}.{suffix}")
        pose = np.linalg.inv(camera.T_cam_world) @ np.diag([1.0, -1, -1, 1])
        pose[:3, :3] = pose[:3, :3].round(digits)
        pose[:3, 3] += offset
        frames.append({"file_path": f"images/{i}.{suffix}", "transform_matrix": pose.tolist(), "time": i})
        if mask:
            mask(PICTURE, folder / f"{i}.png")
            frames[-1]["mask_path"] = f"{i}.png"
    (folder / "transforms.json").write_text(json.dumps(data | {"frames": frames}))
    return folder


def deep_png(factor: int) -> Write:
    """A writer of 16 bits per channel, of which the levels times `factor` are stored."""

    def write(image: NDArray[np.uint8], path: Path) -> None:
        rows = b"".join(b"\0" + (row.astype(">u2") * factor).astype(">u2").tobytes() for row in image)
        chunks = [(b"IHDR", struct.pack(">IIBBBBB", WIDTH, HEIGHT, 16, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows))]
        data = b"\x89PNG\r\n\x1a\n"
        for kind, body in [*chunks, (b"IEND", b"")]:
            data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        path.write_bytes(data)

    return write


def sideways(image: NDArray[np.uint8], path: Path) -> None:
    """Stored with its right side up, as phones do, and EXIF says so."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.ascontiguousarray(np.rot90(image))).save(path, exif=exif)


def told(data: Dataset, word: str) -> bool:
    return any(word in warning for warning in data.warnings)


def test_rotations_of_six_digits_leave_cameras_where_they_are() -> None:
    for camera in CAMERAS:
        R, position = camera.T_cam_world[:3, :3].T.round(6), camera.position + UTM
        T = world_to_camera(R, position)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(-T[:3, :3].T @ T[:3, 3], position, atol=1e-8)


def test_coordinates_far_from_the_origin(tmp_path: Path) -> None:
    """Six digits of rotation in transforms.json, and a cloud of COLMAP."""
    for name, offset in (("near", np.zeros(3)), ("far", UTM)):
        move = Normalization(-offset, 1.0)
        poses = {f"{i}.png": move.camera(camera) for i, camera in enumerate(CAMERAS)}
        folder = tmp_path / name
        write_model(folder / "sparse/0", poses, "PINHOLE", {}, binary=True, offset=offset)
        (folder / "images").mkdir()
        for image in poses:
            as_png(PICTURE, folder / "images" / image)
    near, far = load_dataset(tmp_path / "near"), load_dataset(tmp_path / "far")
    assert near.cloud is not None
    assert far.cloud is not None
    assert far.cloud.points.dtype == np.float32
    np.testing.assert_allclose(far.cloud.points[:40], near.cloud.points[:40], atol=1e-6)
    near, far = (
        load_dataset(capture(tmp_path / f"{digits}", offset=o, digits=digits)) for digits, o in ((9, 0), (6, UTM))
    )
    for one, other in zip(near.train, far.train, strict=True):
        np.testing.assert_allclose(one.camera.position, other.camera.position, atol=1e-5)


def test_a_scan_of_the_whole_building(tmp_path: Path) -> None:
    scene = RNG.uniform(-0.5, 0.5, (1000, 3)) + MIDDLE
    building = RNG.uniform([20, 20, -1], [60, 60, 3], (900, 3))
    write_points(tmp_path / "scan.ply", np.concatenate([scene, building]))
    capture(tmp_path / "scan", ply_file_path="scan.ply")
    (tmp_path / "scan.ply").rename(tmp_path / "scan/scan.ply")
    data = load_dataset(tmp_path / "scan")
    assert data.scale == pytest.approx(BOX / 0.5, rel=0.05)


def test_a_scan_that_cameras_hardly_see(tmp_path: Path) -> None:
    """A fifth of its points is the scene; the others are left out."""
    scene = RNG.uniform(-0.5, 0.5, (1000, 3)) + MIDDLE
    write_points(tmp_path / "scan.ply", np.concatenate([scene, RNG.uniform([50, 50, 200], [90, 90, 300], (4000, 3))]))
    capture(tmp_path / "scan", ply_file_path="scan.ply")
    (tmp_path / "scan.ply").rename(tmp_path / "scan/scan.ply")
    data = load_dataset(tmp_path / "scan")
    assert data.cloud is not None
    assert data.normalization is not None
    np.testing.assert_allclose(data.cloud.points[:1000], data.normalization.points(scene), atol=1e-4)
    assert told(data, "% of its points: of 5000")
    assert data.scale == pytest.approx(BOX / 0.5, rel=0.05)


def test_orientation_where_no_size_is_stated(tmp_path: Path) -> None:
    """The principal point tells it; the angle of view alone does not."""
    missing = {"w": None, "h": None}
    turned = load_dataset(capture(tmp_path / "turned", sideways, **missing))
    np.testing.assert_array_equal(turned.train[0].load(), PICTURE)
    stored = load_dataset(capture(tmp_path / "stored", sideways, cx=HEIGHT / 2, cy=WIDTH / 2, **missing))
    assert stored.train[0].load().shape == (WIDTH, HEIGHT, 3)
    assert not any(told(data, "EXIF") for data in (turned, stored))
    unclear = load_dataset(capture(tmp_path / "unclear", sideways, cx=None, cy=None, **missing))
    assert told(unclear, "EXIF")


def test_orientation_of_exif(tmp_path: Path) -> None:
    """The picture is 64x48, and its file 48x64."""
    turned = load_dataset(capture(tmp_path / "turned", sideways))
    assert not told(turned, "EXIF")
    np.testing.assert_array_equal(turned.train[0].load(), PICTURE)
    stored = load_dataset(capture(tmp_path / "stored", sideways, size=(HEIGHT, WIDTH)))
    assert stored.train[0].load().shape == (WIDTH, HEIGHT, 3)
    assert not told(stored, "EXIF")
    square = capture(tmp_path / "square", lambda image, path: sideways(image[:, :HEIGHT], path), size=(HEIGHT, HEIGHT))
    assert told(load_dataset(square), "EXIF")


@pytest.mark.parametrize(("factor", "dark"), [(257, False), (16, True)])
def test_sixteen_bits(tmp_path: Path, factor: int, dark: bool) -> None:
    data = load_dataset(capture(tmp_path / "deep", deep_png(factor)))
    assert told(data, "16 bits") == dark
    np.testing.assert_array_equal(data.train[0].load(), PICTURE if factor == 257 else PICTURE // 16)


def test_gray_of_sixteen_bits(tmp_path: Path) -> None:
    levels = PICTURE[..., 0]
    data = load_dataset(
        capture(tmp_path / "gray", lambda _, p: Image.fromarray(levels.astype(np.uint16) * 257).save(p))
    )
    np.testing.assert_array_equal(data.train[0].load()[..., 1], levels)
    np.testing.assert_array_equal(gray_thumbnail(Path(data.train[0].source)), levels)


@pytest.mark.parametrize(("alpha", "clear"), [(0, True), (1, True), (255, False)])
def test_images_that_are_transparent(tmp_path: Path, alpha: int, clear: bool) -> None:
    def write(image: NDArray[np.uint8], path: Path) -> None:
        Image.fromarray(np.dstack([image, np.full((HEIGHT, WIDTH), alpha, np.uint8)])).save(path)

    assert told(load_dataset(capture(tmp_path / "clear", write)), "nearly transparent") == clear


def test_format_is_named_whatever_the_file_is_called(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="WebP"):
        load_dataset(capture(tmp_path / "webp", lambda i, p: Image.fromarray(i).save(p, "WEBP"), suffix="jpg"))
    for word, head in {"HEIC": b"\0\0\0\x18ftypheic", "Git LFS": b"version https://git-lfs", "empty": b""}.items():
        with pytest.raises(InputError, match=word):
            load_dataset(capture(tmp_path / word, lambda _, path, head=head: path.write_bytes(head), suffix="jpg"))


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_principal_point_of_another_size(tmp_path: Path, share: float) -> None:
    data = load_dataset(capture(tmp_path / "other", cx=share * WIDTH, cy=share * HEIGHT))
    assert told(data, "principal point") == (share != 0.5)


LEFT = np.where(np.arange(WIDTH) < 20, 0, 255).astype(np.uint8) * np.ones((HEIGHT, 1), np.uint8)  # 20 columns go


@pytest.mark.parametrize(
    "mask",
    [LEFT, LEFT // 255, LEFT.astype(np.uint16) * 257, LEFT > 0]
    + [np.dstack([np.full((HEIGHT, WIDTH, 3), color, np.uint8), LEFT]) for color in (0, 255)],
    ids=["levels", "0 and 1", "16 bits", "1 bit", "alpha of black", "alpha of white"],
)
def test_masks(tmp_path: Path, mask: NDArray[Any]) -> None:
    data = load_dataset(capture(tmp_path / "masked", mask=lambda _, path: Image.fromarray(mask).save(path)))
    assert not told(data, "mask")
    np.testing.assert_array_equal(data.train[0].load_ignored(), LEFT == 0)
