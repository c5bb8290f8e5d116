"""The reader of Neu3D's layout: its cameras see what pictures and videos show; one sentence for what is wrong."""

from __future__ import annotations

import math
import shutil
import sys
from fractions import Fraction
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
import pytest
from helpers.captures import (
    FAR,
    HEIGHT,
    NEAR,
    WIDTH,
    Blobs,
    Change,
    agreement,
    cameras,
    llff_row,
    moved,
    write_nerfies,
    write_neu3d,
    write_points,
    write_video,
)
from helpers.films import turn_film
from PIL import Image

from lapgs_wgpu.data import load_dataset, video_frames
from lapgs_wgpu.data.initial_gaussians import first_points
from lapgs_wgpu.data.readers import neu3d
from lapgs_wgpu.data.readers.poses_bounds import read_rows
from lapgs_wgpu.data.video_frames import _place
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device

SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="module")
def pictures(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good capture of pictures; tests copy it."""
    return write_neu3d(tmp_path_factory.mktemp("pictures") / "toy", device)


@pytest.fixture(scope="module")
def videos(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as videos."""
    pytest.importorskip("av")
    return write_neu3d(tmp_path_factory.mktemp("videos") / "toy", device, video=True, count=3)


@pytest.fixture
def toy(pictures: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pictures, tmp_path / "toy"))


@pytest.fixture
def clip(videos: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(videos, tmp_path / "clip"))


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def frame_of(views: Any, frame: int) -> list[int]:
    return [i for i, view in enumerate(views) if view.name.endswith(f"_{frame:05d}")]


@pytest.mark.parametrize("frame", [0, 2])
def test_cameras_see_what_the_pictures_show(frame: int, toy: Path, device: Device) -> None:
    """LLFF's axes, and poses that speak of pictures twice as large: only the rounding of both sides is left."""
    data = load_dataset(toy)
    shown = frame_of([*data.train, *data.test], frame)
    assert len(shown) == 4
    assert agreement(data, moved(frame), device, shown) > 50


def test_cameras_see_what_the_videos_show(clip: Path, device: Device) -> None:
    """Every frame is its own: neighbours differ by far more."""
    data = load_dataset(clip)
    for frame in range(3):
        shown = frame_of([*data.train, *data.test], frame)
        assert len(shown) == 3
        assert agreement(data, moved(frame), device, shown) > 38
        assert agreement(data, moved((frame + 1) % 3), device, shown) < 34


def test_the_first_camera_is_held_out(toy: Path) -> None:
    data = load_dataset(toy)
    assert [view.name for view in data.test] == [f"test_cam00_{i:05d}" for i in range(3)]
    assert len(data.train) == 9
    assert not any("cam00" in view.source for view in data.train)
    assert len(data.cameras) == 3
    assert [view.time for view in data.test] == [0, 1 / 3, 2 / 3]
    np.testing.assert_allclose(data.times, [0, 1 / 3, 2 / 3])


def test_cameras_and_frames_go_by_number(device: Device, tmp_path: Path) -> None:
    """cam2 comes before cam10, and 9.png before 10.png, though not as texts."""
    toy = write_neu3d(tmp_path / "toy", device, count=3, frames=2)
    (toy / "cam00").rename(toy / "cam2")
    (toy / "cam01").rename(toy / "cam9")
    (toy / "cam02").rename(toy / "cam10")
    for camera in ("cam2", "cam9", "cam10"):
        (toy / camera / "images/0000.png").rename(toy / camera / "images/frame_9.png")
        (toy / camera / "images/0001.png").rename(toy / camera / "images/frame_10.png")
    data = load_dataset(toy)
    (warning,) = [text for text in data.warnings if "order" in text]
    assert "row 0 is of cam2; if they are in the order of the names, in which it is of cam10" in warning
    assert [view.name for view in data.test] == ["test_cam2_00000", "test_cam2_00001"]
    for frame in range(2):
        assert agreement(data, moved(frame), device, frame_of([*data.train, *data.test], frame)) > 50


def test_masks_have_the_names_of_the_images(toy: Path, tmp_path: Path) -> None:
    """Not those of the images' places in the film: these begin with 7.png."""
    for file in sorted((toy).glob("cam*/images/*.png"), reverse=True):
        file.rename(file.with_name(f"{int(file.stem) + 7}.png"))
    for camera in range(1, 4):
        folder = tmp_path / f"masks/cam{camera:02}"
        folder.mkdir(parents=True)
        for frame in range(10):  # of a longer film
            Image.new("L", (WIDTH, HEIGHT), 255 if frame == 8 else 0).save(folder / f"{frame}.png")
    data = load_dataset(toy, masks=tmp_path / "masks")
    ignored = {view.name: view.load_ignored() for view in data.train}
    assert {name for name, pixels in ignored.items() if pixels is not None and pixels.all()} == {
        f"train_cam{camera:02}_00001" for camera in range(1, 4)
    }
    assert sum(pixels is not None and not pixels.any() for pixels in ignored.values()) == 6


def test_pictures_go_before_a_video(clip: Path, toy: Path) -> None:
    shutil.copytree(toy / "cam00", clip / "cam00")
    data = load_dataset(clip)
    assert data.test[1].source.endswith("cam00/images/0001.png")
    assert data.train[1].source.endswith("cam01.mp4, frame 1")


def test_frames_are_shrunk_with_their_cameras(clip: Path, device: Device) -> None:
    data = load_dataset(clip, image_size=32)
    assert data.train[0].load().shape == (24, 32, 3)
    full = load_dataset(clip).train[0].camera.K
    np.testing.assert_allclose(data.train[0].camera.K, full * np.array([[0.5], [0.5], [1]]), atol=1e-9)


def test_a_video_is_unpacked_once(clip: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole, outside the capture, and anew when the video is another one."""
    before = sorted(file.name for file in clip.iterdir())
    first = load_dataset(clip).train[2].load()
    unpacked = [path for path in cache.rglob("*") if path.is_dir() and path.name.startswith("cam01-64x48")]
    assert sorted(file.name for file in unpacked[0].iterdir()) == ["00000.png", "00001.png", "00002.png"]
    assert not list(cache.rglob("*.partial"))
    assert sorted(file.name for file in clip.iterdir()) == before
    monkeypatch.setattr(video_frames.Video, "_unpack", lambda *_: pytest.fail("unpacked twice"))
    data = load_dataset(clip)
    np.testing.assert_array_equal(data.train[2].load(), first)
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    shutil.copyfile(clip / "cam02.mp4", clip / "cam01.mp4")
    assert (load_dataset(clip).train[2].load() != first).any()


def test_a_video_that_breaks_off_leaves_nothing(clip: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = load_dataset(clip)
    monkeypatch.setattr(
        video_frames, "_write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    with pytest.raises(InputError, match=r"No space left.*XDG_CACHE_HOME.*GB"):
        data.train[0].load()
    assert not list(cache.rglob("cam01*"))
    assert not list(cache.rglob("*.partial"))


def test_a_video_with_fewer_frames_than_packets(clip: Path) -> None:
    recording = video_frames.Video(clip / "cam01.mp4")
    recording.frames = 4
    with pytest.raises(InputError, match=r"cam01\.mp4 has 4 frames, and 3 can be decoded"):
        recording.read(0, (WIDTH, HEIGHT))


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_video_of_a_turned_camera_is_upright(clip: Path, degrees: int) -> None:
    """The header's rotation, by which players and COLMAP's images are upright."""
    path = clip / "cam01.mp4"
    before = video_frames.Video(path).read(2, (WIDTH, HEIGHT))
    turn_film(path, degrees)
    video = video_frames.Video(path)
    assert video.size == ((WIDTH, HEIGHT) if degrees == 180 else (HEIGHT, WIDTH))
    np.testing.assert_array_equal(video.read(2, video.size), np.rot90(before, -degrees // 90))


def test_frames_that_an_edit_list_cuts_off_are_none(tmp_path: Path) -> None:
    """A film that was cut without being encoded again begins before what it shows."""
    levels = [20 * i for i in range(10)]
    path = tmp_path / "cut.mp4"
    write_video(path, [np.full((HEIGHT, WIDTH, 3), level, np.uint8) for level in levels], cut=0.1)
    video = video_frames.Video(path)
    assert video.frames == 7
    shown = [video.read(i, (WIDTH, HEIGHT)).mean() for i in range(7)]
    np.testing.assert_allclose(shown, levels[3:], atol=2)


def test_pixels_that_are_not_square_are_refused(clip: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(clip / "cam01.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for packet in [*stream.encode(av.VideoFrame(WIDTH, HEIGHT, "yuv420p")), *stream.encode()]:
            file.mux(packet)
    with pytest.raises(InputError, match=r"cam01\.mp4 has frames of 64x48 pixels, each 1\.33 times as wide as high"):
        load_dataset(clip)


def test_without_pyav(clip: Path, toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r'cam00\.mp4 needs PyAV.*pip install "lapgs-wgpu\[prepare\]".*images/\*\.png'):
        load_dataset(clip)
    assert len(load_dataset(toy).train) == 9


def test_the_cloud_comes_along(toy: Path) -> None:
    """The downsampled one before the whole one, with its colors, moved like the cameras."""
    blobs = Blobs.random()
    write_points(toy / "points3D.ply", np.zeros((7, 3)))
    write_points(toy / "points3D_downsample2.ply", blobs.means.numpy(), np.round(255 * blobs.colors.numpy()))
    data = load_dataset(toy)
    assert data.cloud is not None
    assert data.normalization is not None
    np.testing.assert_allclose(data.cloud.points, data.normalization.points(blobs.means.double().numpy()), atol=1e-5)
    np.testing.assert_allclose(data.cloud.colors, blobs.colors, atol=0.5 / 255 + 1e-6)
    assert np.abs(data.cloud.points).max() == pytest.approx(1.3, rel=0.1)
    points, colors = first_points(data, 1000, 1.3, 0)
    np.testing.assert_array_equal(points, data.cloud.points)
    few, few_colors = first_points(data, 10, 1.3, 0)
    assert few.shape == (10, 3)
    index = [int(np.flatnonzero((points == point).all(axis=1))[0]) for point in few]
    np.testing.assert_array_equal(few_colors, colors[index])


def test_without_a_cloud_gaussians_start_where_views_overlap(toy: Path) -> None:
    data = load_dataset(toy)
    assert data.cloud is None
    assert data.normalization is not None
    points, colors = first_points(data, 2000, 99.0, 0)
    assert points.shape == colors.shape == (2000, 3)
    assert points.dtype == np.float32
    assert (colors == 0.5).all()
    inside = np.zeros(len(points))
    for camera in data.cameras:
        local = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
        pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
        depth = local[:, 2] / data.normalization.scale
        seen = (pixels > -0.01).all(axis=1) & (pixels < [WIDTH + 0.01, HEIGHT + 0.01]).all(axis=1)
        inside += seen & (depth > NEAR - 1e-3) & (depth < FAR + 1e-3)
    assert inside.min() >= 2  # of three
    low, high = np.percentile(points, [1, 99], axis=0)
    assert (high - low).max() == pytest.approx(2.6, rel=0.1)
    np.testing.assert_array_equal(points, first_points(data, 2000, 99.0, 0)[0])
    assert (points != first_points(data, 2000, 99.0, 1)[0]).any()


def test_a_cloud_in_other_coordinates_is_refused(toy: Path) -> None:
    write_points(toy / "points3D.ply", Blobs.random().means.numpy() + np.array([50, 0, 0]))
    with pytest.raises(InputError, match=r"points3D\.ply: the training cameras see 0 %.*1\.29.*stand 49\.6 away"):
        load_dataset(toy)


def test_the_true_poses_of_a_published_scene(tmp_path: Path) -> None:
    """Twenty cameras in two rows that look the same way, at something before all of them, upright."""
    path = SHARED / "neu3d/cut_roasted_beef_poses/poses_bounds.npy"
    if not path.is_file():
        pytest.skip("scenes not at hand")
    for number in range(20):
        (tmp_path / f"toy/cam{number:02d}/images").mkdir(parents=True)
        Image.new("RGB", (169, 127)).save(tmp_path / f"toy/cam{number:02d}/images/0000.png")
    shutil.copyfile(path, tmp_path / "toy/poses_bounds.npy")
    data = load_dataset(tmp_path / "toy")
    rotations = np.stack([camera.T_cam_world[:3, :3] for camera in data.cameras])
    ahead, down = rotations[:, 2], rotations[:, 1]
    assert (ahead @ ahead.mean(axis=0) > 0.7).all()
    assert (down @ down.mean(axis=0) > 0.7).all()
    assert data.depths is not None
    for camera in data.cameras:
        local = camera.T_cam_world[:3, :3] @ data.focus + camera.T_cam_world[:3, 3]
        assert data.depths[0] / 2 < local[2] < data.depths[1]
    centres = np.stack([camera.position for camera in data.cameras])
    right = rotations[:, 0].mean(axis=0)
    spread = np.ptp(centres @ right), np.ptp(centres @ down.mean(axis=0)), np.ptp(centres @ ahead.mean(axis=0))
    assert spread[0] > 2 * spread[1]  # wider than high
    assert spread[0] > 2 * spread[2]  # than deep
    assert data.cameras[0].K[0, 0] == pytest.approx(1462.7383 * 169 / 2704, rel=1e-2)


def test_a_real_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Videos and, for the test camera, pictures: the same scene, in the same colors."""
    folder = SHARED / "rendered/swing_mv"
    if not folder.is_dir():
        pytest.skip("scenes not at hand")
    pytest.importorskip("av")
    data = load_dataset(folder)
    assert (len(data.train), len(data.test), len(data.times)) == (350, 50, 50)
    assert data.train[0].load().shape == (252, 336, 3)
    for frame in (0, 20, 40):  # the pink ring is at one place: eight lines of sight meet there
        views = [view for view in (*data.train, *data.test) if view.name.endswith(f"_{frame:05d}")]
        across, right_side, seen = np.zeros((3, 3)), np.zeros(3), []
        for view in views:
            red, green, blue = np.moveaxis(view.load()[..., :3].astype(int), -1, 0)
            rows, columns = np.nonzero((red - green > 60) & (blue - green > 40))
            seen.append(np.array([columns.mean() + 0.5, rows.mean() + 0.5]))
            ray = view.camera.T_cam_world[:3, :3].T @ np.linalg.solve(view.camera.K, [*seen[-1], 1])
            away = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            across, right_side = across + away, right_side + away @ view.camera.position
        ring = np.linalg.solve(across, right_side)
        for view, pixel in zip(views, seen, strict=True):
            local = view.camera.T_cam_world[:3, :3] @ ring + view.camera.T_cam_world[:3, 3]
            assert np.linalg.norm((view.camera.K @ local)[:2] / local[2] - pixel) < 2
    decoded = video_frames.Video(folder / "cam00.mp4").read(20, (336, 252)).astype(float)
    error = decoded - data.test[20].load()[..., :3]
    assert 10 * np.log10(255**2 / np.square(error).mean()) > 30
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.8  # another color matrix, or range, shows here


# What is refused


def poses(row: int, column: int | slice, value: Any) -> Change:
    def change(folder: Path, arrays: Any) -> None:
        path = folder / "poses_bounds.npy"
        rows = np.load(path)
        rows[row, column] = value
        np.save(path, rows)

    return change


def other_array(value: Any) -> Change:
    return lambda folder, _: np.save(folder / "poses_bounds.npy", value)


def picture(name: str, size: tuple[int, int] = (WIDTH, HEIGHT), mode: str = "RGB") -> Change:
    return lambda folder, _: Image.new(mode, size).save(folder / name)


def gone(*names: str) -> Change:
    def change(folder: Path, _: Any) -> None:
        for name in names:
            shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()

    return change


def square(folder: Path, _: Any) -> None:
    for file in folder.glob("cam*/images/*.png"):
        Image.new("RGB", (64, 64)).save(file)


def cloud(points: np.ndarray) -> Change:
    return lambda folder, _: write_points(folder / "points3D.ply", points)


GOOD = np.array([llff_row(camera) for camera in cameras(4)])
FILE = "poses_bounds.npy"
OPENCV = GOOD.copy()  # its third axis points ahead
OPENCV[:, [2, 7, 12]] *= -1
BAD: dict[str, tuple[Change, list[str]]] = {
    "text": (lambda folder, _: (folder / FILE).write_text("hello"), [FILE]),
    "objects": (other_array(np.array([{}])), [FILE]),
    "14 numbers": (other_array(GOOD[:, :14]), [FILE, "17"]),
    "one row less": (other_array(GOOD[:3]), [FILE]),
    "NaN": (poses(1, 2, math.nan), [FILE, "nan"]),
    "far away": (poses(1, 3, 1e12), [FILE, "1e+12"]),
    "focal length tiny": (poses(2, 14, 1e-9), [FILE, "0.05"]),
    "focal length 0": (poses(2, 14, 0), [FILE, "focal"]),
    "height 0": (poses(2, 4, 0), [FILE, "height"]),
    "near beyond far": (poses(3, slice(15, 17), [8, 2]), [FILE]),
    "near 0": (poses(3, 15, 0), [FILE]),
    "no rotation": (poses(0, slice(0, 3), [2, 0, 0]), [FILE, "pose", "rotation"]),
    "OpenCV's axes": (other_array(OPENCV), [FILE, "left-handed"]),
    "one camera": (gone("cam01", "cam02", "cam03"), ["recordings of 1 cameras"]),
    "no pictures": (gone(*(f"cam01/images/{i:04d}.png" for i in range(3))), ["cam01/images"]),
    "a frame less": (gone("cam02/images/0001.png"), ["cam02", "cam00", "3"]),
    "other size": (picture("cam02/images/0000.png", (32, 24)), ["cam02", "32x24", "cam00", "64x48"]),
    "one of another size": (picture("cam02/images/0002.png", (32, 24)), ["cam02/images/0002.png", "32x24", "64x48"]),
    "other proportions": (square, ["cam00", "64x64", "128x96", FILE]),
    "a number twice": (picture("cam01/images/x_001.png"), ["cam01/images"]),
    "no number": (picture("cam01/images/last.png"), ["last.png"]),
    "cloud of text": (lambda folder, _: (folder / "points3D.ply").write_text("hello"), ["points3D.ply"]),
    "cloud of NaN": (cloud(np.full((5, 3), np.nan)), ["points3D.ply"]),
    "empty cloud": (cloud(np.zeros((0, 3))), ["points3D.ply"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_capture_is_refused_in_one_sentence(name: str, toy: Path) -> None:
    change, words = BAD[name]
    change(toy, {})
    with pytest.raises(InputError) as caught:
        load_dataset(toy)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 500
    for word in [str(toy), *words]:
        assert word in message


@pytest.mark.parametrize("content", [b"", b"hello", b"\0" * 4096])
def test_a_file_that_is_no_video(content: bytes, clip: Path) -> None:
    (clip / "cam01.mp4").write_bytes(content)
    with pytest.raises(InputError, match=r"cam01\.mp4 is not a readable video"):
        load_dataset(clip)


def test_a_damaged_video_is_named(clip: Path) -> None:
    path = clip / "cam01.mp4"
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    data[start : start + 4000] = bytes(4000)
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"cam01\.mp4"):
        load_dataset(clip).train[0].load()


def test_found_in_videos(clip: Path) -> None:
    """By fuzzing: a codec that nobody knows, and names that are no UTF-8."""
    path = clip / "cam01.mp4"
    good = path.read_bytes()
    path.write_bytes(good.replace(b"avc1\0\0\0\0\0\0\0\1", b"xyz1\0\0\0\0\0\0\0\1"))
    with pytest.raises(InputError, match=r"cam01\.mp4 is in a format that PyAV cannot decode"):
        load_dataset(clip)
    assert b"VideoHandler" in good
    path.write_bytes(good.replace(b"VideoHandler", b"\xed\xa0\x80eoHandler"))
    assert load_dataset(clip).train[0].load().shape == (HEIGHT, WIDTH, 3)


def test_videos_have_bounds(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = video_frames.Video(clip / "cam01.mp4")
    recording.size = (2 * WIDTH, HEIGHT)
    with pytest.raises(InputError, match=f"frame 0 has {WIDTH}x{HEIGHT} pixels, and the first has {2 * WIDTH}x"):
        recording.read(0, (WIDTH, HEIGHT))
    monkeypatch.setattr(video_frames, "LARGEST_FRAME", WIDTH * HEIGHT - 1)
    with pytest.raises(InputError, match=r"cam00\.mp4 has frames of 64x48 pixels, and at most 3,071 pixels"):
        load_dataset(clip)
    recording = video_frames.Video.__new__(video_frames.Video)
    recording.path, recording.frames, recording.size = clip / "cam02.mp4", 3, (WIDTH, HEIGHT)
    recording._display = video_frames.Display(0, mirrored=False)
    with pytest.raises(InputError, match=r"cam02\.mp4"):  # the decoder has the bound, too
        recording.read(0, (WIDTH, HEIGHT))


def test_a_video_of_another_length(device: Device, clip: Path, tmp_path: Path) -> None:
    shutil.copyfile(
        write_neu3d(tmp_path / "b", device, count=2, frames=2, video=True) / "cam01.mp4", clip / "cam02.mp4"
    )
    with pytest.raises(InputError, match=r"cam02\.mp4 has 2 frames and .*cam00\.mp4 has 3"):
        load_dataset(clip)


def test_two_formats_in_one_folder(toy: Path, device: Device) -> None:
    write_nerfies(toy, device)
    with pytest.raises(InputError, match=r"files of HyperNeRF .* and of Neu3D .*one format"):
        load_dataset(toy)


def test_formats_are_told_by_their_files(toy: Path) -> None:
    with pytest.raises(InputError, match=r"dataset\.json .*poses_bounds\.npy .*\(Neu3D\).*; it holds the scenes toy"):
        load_dataset(toy.parent)


def test_rows_are_llffs(tmp_path: Path) -> None:
    """down, right, back: as in the rows that this file writes, but by hand."""
    row = [*np.array([[0, 1, 0, 5, 48], [-1, 0, 0, 6, 64], [0, 0, 1, 7, 80]], float).ravel(), 1, 9]
    path = tmp_path / "poses_bounds.npy"
    np.save(path, np.array([row]))
    (found,) = read_rows(path, ["cam00"], "recordings")
    T_cam_world = neu3d.llff_pose(found)
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    np.testing.assert_array_equal(-R.T @ t, [5, 6, 7])
    np.testing.assert_array_equal(R, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    np.testing.assert_array_equal(found.lens.K, [[80, 0, 32], [0, 80, 24], [0, 0, 1]])
    assert (found.lens.width, found.lens.height, found.depths) == (64, 48, (1, 9))


@pytest.mark.parametrize(
    ("folder", "place"),
    [
        (PurePosixPath("/"), ""),
        (PurePosixPath("/home/me/films/dance"), "films-dance"),
        (PureWindowsPath("D:\\dance"), "dance"),
        (PureWindowsPath("\\\\nas\\films\\dance"), "dance"),
        (PureWindowsPath("C:\\Users\\me\\dance"), "me-dance"),
    ],
)
def test_unpacked_films_stay_in_the_cache(folder: PurePath, place: str) -> None:
    assert _place(folder) == place
    assert not type(folder)(place).anchor
