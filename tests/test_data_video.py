"""Neu3D's recordings: their order, and the frames of videos, which are unpacked once, upright and within bounds."""

import shutil
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import HEIGHT, WIDTH, Blobs, agreement, moved, write_neu3d, write_video
from helpers.films import turn_film
from PIL import Image

from lapgs_wgpu.data import View, load_dataset, video_frames
from lapgs_wgpu.data.images import Pixels
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device


@pytest.fixture
def clip(device: Device, tmp_path: Path) -> Path:
    pytest.importorskip("av")
    return write_neu3d(tmp_path / "clip", device, video=True, count=3)


@pytest.fixture
def toy(device: Device, tmp_path: Path) -> Path:
    return write_neu3d(tmp_path / "toy", device)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def frame_of(view: View) -> int:
    return int(view.name.rpartition("_")[2])


def test_cameras_see_what_the_videos_show(clip: Path, device: Device) -> None:
    """Every frame is its own: neighbours differ by far more."""
    data = load_dataset(clip)
    assert len(data.train) + len(data.test) == 9
    assert agreement(data, device, lambda view: moved(frame_of(view))) > 38
    for frame in range(3):

        def other(view: View, frame: int = frame) -> Blobs | None:
            return moved((frame + 1) % 3) if frame_of(view) == frame else None

        assert agreement(data, device, other) < 34


def test_cameras_and_frames_go_by_number(device: Device, tmp_path: Path) -> None:
    """cam2 comes before cam10, and 9.png before 10.png, though not as texts."""
    toy = write_neu3d(tmp_path / "toy", device, count=3, frames=2)
    for old, new in (("cam00", "cam2"), ("cam01", "cam9"), ("cam02", "cam10")):
        (toy / old).rename(toy / new)
        for i in range(2):
            (toy / new / f"images/{i:04d}.png").rename(toy / new / f"images/frame_{9 + i}.png")
    data = load_dataset(toy)
    assert any("numbers, cam2, cam9, cam10" in text for text in data.warnings)
    assert [view.name for view in data.test] == ["test_cam2_00000", "test_cam2_00001"]
    assert agreement(data, device, lambda view: moved(frame_of(view))) > 50


def test_masks_have_the_names_of_the_images(toy: Path, tmp_path: Path) -> None:
    """Not those of the images' places in the film: these begin with 7.png."""
    for file in sorted((toy).glob("cam*/images/*.png"), reverse=True):
        file.rename(file.with_name(f"{int(file.stem) + 7}.png"))
    for camera in range(1, 4):
        folder = tmp_path / f"masks/cam{camera:02}"
        folder.mkdir(parents=True)
        for frame in range(10):  # of a longer film
            Image.new("L", (WIDTH, HEIGHT), 255 if frame == 8 else 0).save(folder / f"{frame}.png")
    for view in load_dataset(toy, masks=tmp_path / "masks").train:
        ignored = view.load_ignored()
        assert ignored is not None
        assert ignored.mean() == (frame_of(view) == 1)


def test_films_count_where_not_all_cameras_have_images_and_are_shrunk(clip: Path, toy: Path) -> None:
    full = load_dataset(clip).train[0].camera.K
    shutil.copytree(toy / "cam00", clip / "cam00")
    data = load_dataset(clip, image_size=32)
    assert data.train[1].source.endswith("cam01.mp4, frame 1")
    assert data.train[0].load().shape == data.test[0].load().shape == (24, 32, 3)
    np.testing.assert_allclose(data.train[0].camera.K, full * np.array([[0.5], [0.5], [1]]), atol=1e-9)
    (clip / "cam00.mp4").unlink()
    with pytest.raises(InputError, match="films of 2 cameras and images of 1"):
        load_dataset(clip)


def test_a_film_is_unpacked_once(clip: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole, outside the capture, and anew when the film is another one."""
    before = sorted(file.name for file in clip.iterdir())
    first = load_dataset(clip).train[2].load()
    unpacked = [path for path in cache.rglob("*") if path.is_dir() and path.name.startswith("cam01-64x48")]
    assert sorted(file.name for file in unpacked[0].iterdir()) == ["00000.png", "00001.png", "00002.png"]
    assert not list(cache.rglob("*.partial"))
    assert sorted(file.name for file in clip.iterdir()) == before
    with monkeypatch.context() as patch:
        patch.setattr(video_frames, "_unpack", lambda *_: pytest.fail("unpacked twice"))
        np.testing.assert_array_equal(load_dataset(clip).train[2].load(), first)
    shutil.copyfile(clip / "cam02.mp4", clip / "cam01.mp4")
    assert (load_dataset(clip).train[2].load() != first).any()


def test_a_film_that_does_not_fit_on_the_disk_leaves_nothing(
    clip: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(video_frames, "_write", full)
    with pytest.raises(InputError, match="XDG_CACHE_HOME"):
        load_dataset(clip)
    assert not list(cache.rglob("cam01*"))


def frames(path: Path) -> list[Pixels]:
    return [image.read(image.size) for image in video_frames.unpacked(path, None)]


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_film_of_a_turned_camera_is_upright(clip: Path, degrees: int) -> None:
    """The header's rotation, by which players and COLMAP's images are upright."""
    before = frames(clip / "cam01.mp4")[2]
    turn_film(clip / "cam01.mp4", degrees)
    np.testing.assert_array_equal(frames(clip / "cam01.mp4")[2], np.rot90(before, -degrees // 90))


def test_frames_that_an_edit_list_cuts_off_are_none(tmp_path: Path) -> None:
    """A film that was cut without being encoded again begins before what it shows."""
    levels = [20 * i for i in range(10)]
    path = tmp_path / "cut.mp4"
    write_video(path, [np.full((HEIGHT, WIDTH, 3), level, np.uint8) for level in levels], cut=0.1)
    np.testing.assert_allclose([frame.mean() for frame in frames(path)], levels[3:], atol=2)


def pixels_that_are_not_square(path: Path) -> None:
    av = __import__("av")
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for packet in [*stream.encode(av.VideoFrame(WIDTH, HEIGHT, "yuv420p")), *stream.encode()]:
            file.mux(packet)


def frames_of_zeros(path: Path) -> None:
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    data[start : start + 4000] = bytes(4000)
    path.write_bytes(bytes(data))


BAD_VIDEOS = [
    pixels_that_are_not_square,
    frames_of_zeros,
    lambda path: write_video(path, [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 2),  # a frame less than the others
    lambda path: path.write_bytes(b""),
    lambda path: path.write_bytes(b"\0" * 4096),
    lambda path: path.write_bytes(path.read_bytes().replace(b"avc1\0\0\0\0\0\0\0\1", b"xyz1\0\0\0\0\0\0\0\1")),
]


@pytest.mark.parametrize("number", range(len(BAD_VIDEOS)))
def test_a_bad_video_is_named(number: int, clip: Path) -> None:
    BAD_VIDEOS[number](clip / "cam01.mp4")
    with pytest.raises(InputError, match=r"cam01\.mp4"):
        load_dataset(clip)


def test_films_have_bounds(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_frames, "LARGEST_FRAME", WIDTH * HEIGHT - 1)
    with pytest.raises(InputError, match=r"cam00\.mp4"):
        load_dataset(clip)


def test_without_pyav(clip: Path, toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"cam00\.mp4 needs PyAV"):
        load_dataset(clip)
    assert len(load_dataset(toy).train) == 9
