"""Films as phones and cameras record them, and the images that are taken of them."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.films import noise_pictures, turn_film, write_film
from PIL import Image

from lapgs_wgpu.data.images import oriented, oriented_size
from lapgs_wgpu.data.video_frames import orientation
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.film import Film, Picture, Transfer, extract, images_per_second, to_sdr
from lapgs_wgpu.prepare.rig import common_times, extract_in_step, shapes_of, start_together

av = pytest.importorskip("av")


def seconds(path: Path) -> list[float]:
    return [frame.seconds for frame in Film(path).frames()]


def test_times_of_a_film_of_variable_rate(tmp_path: Path) -> None:
    times = [0.0, 0.033, 0.05, 0.2, 0.7, 0.71]
    assert seconds(write_film(tmp_path / "film.mkv", noise_pictures(6), times=times)) == pytest.approx(times, abs=2e-3)


def test_frames_without_time_stamps_are_counted(tmp_path: Path) -> None:
    """A bare H.264 stream has none."""
    times = seconds(write_film(tmp_path / "film.h264", noise_pictures(6), rate=25))
    assert len(times) == 6
    assert np.diff(times) == pytest.approx(1 / 25)


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_frames_stand_upright_and_have_square_pixels(tmp_path: Path, degrees: int) -> None:
    """As of cameras that record 1440x1080 to be shown as 1920x1080, held in any way."""
    picture = np.full((48, 48, 3), 30, np.uint8)
    picture[:24, :24] = 220  # the top left of what is stored
    path = write_film(tmp_path / "film.mp4", [picture] * 3, aspect="4/3")
    if degrees:
        turn_film(path, degrees)
    film = Film(path)
    expected = np.rot90(np.repeat(picture[:, :, 0], 4, axis=1)[:, ::3], -degrees // 90)
    for frame in film.frames():
        assert film.size == expected.shape[::-1]
        assert frame.pixels(1000).shape == (*expected.shape, 3)
        assert np.abs(frame.pixels(1000)[..., 0].astype(int) - expected).mean() < 5
        assert np.abs(frame.gray - expected).mean() < 8
        assert max(frame.pixels(32).shape) == 32


@pytest.mark.parametrize(
    ("trc", "transfer", "white", "half", "plain"),
    [("arib-std-b67", "HLG", 0.75, 0.632, 133), ("smpte2084", "PQ", 0.58, 0.508, 140)],
)
def test_hdr_films_look_like_ordinary_ones(
    tmp_path: Path, trc: str, transfer: Transfer, white: float, half: float, plain: int
) -> None:
    """Gray of the reference white in 10 bits becomes (almost) white; half of its light sRGB's level for half."""
    for signal, level in ((white, 233), (half, 188)):
        deep = np.full((4, 4, 3), round(65535 * signal), np.uint16)
        assert np.abs(to_sdr(deep, transfer).astype(int) - level).max() <= 12
    options = {"x264-params": f"colorprim=bt2020:transfer={trc}:colormatrix=bt2020nc"}
    gray = [np.full((48, 64, 3), 140, np.uint8)] * 3
    path = write_film(tmp_path / "film.mkv", gray, options=options, pix_fmt="yuv420p10le")
    for frame in Film(path).frames():
        pixels = frame.pixels(1000)
        assert np.ptp(pixels) <= 3
        assert abs(int(pixels[0, 0, 0]) - plain) > 5, "it was taken for an ordinary film"


def test_a_film_cut_in_the_middle_of_a_packet(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """What comes before is used, and the user is told."""
    path = write_film(tmp_path / "film.mkv", noise_pictures(40), options={"g": "5"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 7])
    film = Film(path)
    assert 10 < len(list(film.frames())) < 30
    assert capfd.readouterr().out.count("copy it again") == 1


def test_the_larger_of_two_streams_is_used(tmp_path: Path) -> None:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as file:
        streams = []
        for width, height in ((32, 32), (64, 48)):
            stream = file.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for stream in streams:
            for picture in noise_pictures(5, stream.width, stream.height):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            file.mux(stream.encode())
    assert [frame.pixels(1000).shape for frame in Film(path).frames()] == [(48, 64, 3)] * 5


def test_frames_larger_than_may_be_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_film(tmp_path / "film.mp4", noise_pictures(2))
    monkeypatch.setattr("lapgs_wgpu.data.video_frames.LARGEST_FRAME", 64 * 47)
    with pytest.raises(InputError, match="64x48"):
        Film(path)


def test_the_sharpest_frame_of_each_span(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = noise_pictures(12)
    soft = [p if i % 3 == 1 else np.full_like(p, p.mean()) // 2 + p // 2 for i, p in enumerate(pictures)]
    film = Film(write_film(tmp_path / "film.mkv", soft))
    monkeypatch.setattr("lapgs_wgpu.prepare.film.LONGER_SIDE", 32)
    found = extract(film, tmp_path, 10)
    assert [picture.name for picture in found] == [f"{round(100 * i + 33.3):08d}.jpg" for i in range(4)]
    assert sorted(path.name for path in tmp_path.glob("*.jpg")) == [picture.name for picture in found]
    with Image.open(tmp_path / found[0].name) as image:
        assert image.size == (32, 24)


def test_repeated_and_blurred_frames_are_left_out(tmp_path: Path) -> None:
    pictures = noise_pictures(12)
    pictures[2] = pictures[1]
    pictures[6] = np.full_like(pictures[6], 90) + pictures[6] // 20
    found = extract(Film(write_film(tmp_path / "film.mkv", pictures, rate=10)), tmp_path, 10)
    kept = [i for i in range(12) if i not in (2, 6)]
    assert [round(10 * picture.seconds) for picture in found] == kept
    assert sorted(path.name for path in tmp_path.glob("*.jpg")) == [f"{100 * i:08d}.jpg" for i in kept]


def test_a_long_film_gives_fewer_images_a_second(tmp_path: Path) -> None:
    short, long = (Film(write_film(tmp_path / f"{i}.mkv", noise_pictures(3))) for i in range(2))
    short.seconds, long.seconds = 5.0, 60.0
    assert images_per_second([long], None) == 5
    assert images_per_second([long], 12) == 12
    assert images_per_second([short], None) == 15
    assert images_per_second([short, long], None) == 30
    short.seconds = 12.0
    assert images_per_second([short, long], None) == 25


def test_films_of_still_cameras_are_taken_in_step(tmp_path: Path) -> None:
    films = [Film(write_film(tmp_path / f"{n}.mkv", noise_pictures(n))) for n in (12, 18)]
    found = extract_in_step(films, tmp_path / "images", 10, shapes_of(films))
    for number, pictures in enumerate(found):
        names = [f"cam{number:02d}/{100 * i:08d}.jpg" for i in range(4)]
        assert {span: picture.name for span, picture in pictures.items()} == dict(enumerate(names))
        assert sorted(path.name for path in (tmp_path / f"images/cam{number:02d}").iterdir()) == [n[6:] for n in names]


def test_films_are_brought_into_step_by_their_sound(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """The second film begins 0.4 s later; a third one heard something else."""
    rng = np.random.default_rng(0)
    claps = rng.normal(size=24000) * np.repeat(rng.random(120) ** 6, 200)
    other = rng.normal(size=24000) * np.repeat(rng.random(120) ** 6, 200)
    films = []
    for number, (sound, begin) in enumerate(((claps, 0.0), (claps, 0.4), (other, 0.0))):
        with av.open(str(tmp_path / f"{number}.mp4"), "w") as file:
            video, audio = file.add_stream("libx264", rate=30), file.add_stream("aac", rate=8000, layout="mono")
            video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
            for picture in noise_pictures(60):
                file.mux(video.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            heard = sound[round(8000 * begin) :][:16000] + 0.001 * rng.normal(size=16000)
            frame = av.AudioFrame.from_ndarray(heard.astype(np.float32)[None], "fltp", "mono")
            frame.rate = 8000
            file.mux([*audio.encode(frame), *audio.encode(), *video.encode()])
        films.append(Film(tmp_path / f"{number}.mp4"))
    start_together(films[:2])
    assert [film.start for film in films[:2]] == pytest.approx([0.4, 0.0], abs=0.01)
    assert "by their sound" in capfd.readouterr().out
    found = [[frame.seconds for frame in film.frames()] for film in films[:2]]
    assert found[0] == pytest.approx(np.arange(48) / 30, abs=1e-3)
    assert found[1] == pytest.approx(np.arange(60) / 30, abs=1e-3)
    start_together([films[1], films[2]])
    assert "2.mp4 has no sound in common with 1.mp4" in capfd.readouterr().out


def test_films_of_other_sizes_get_one(tmp_path: Path) -> None:
    """Shrunk until one side is equal, then cut at the middle; what would lose half is refused."""

    def film(width: int, height: int) -> Film:
        return Film(write_film(tmp_path / f"{width}.mkv", noise_pictures(4, width, height)))

    shapes = shapes_of([film(64, 48), film(80, 48), film(128, 120)])
    assert [shape.shrunk for shape in shapes] == [(64, 48), (80, 48), (64, 60)]
    assert [shape.cut[1].start for shape in shapes] == [0, 8, 0]
    assert [shape.apply(next(film(128, 120).frames())).shape for shape in shapes[2:]] == [(48, 64, 3)]
    with pytest.raises(InputError, match=r"48x160.*get one size, 48x48"):
        shapes_of([film(48, 160), film(160, 48)])


def test_common_times() -> None:
    """Where one camera has no image for a while."""
    cameras = [{i: Picture(f"{n}/{i}", i / 10) for i in range(20) if n == 0 or not 5 <= i < 9} for n in range(2)]
    assert common_times(cameras) == [*range(5), *range(9, 20)]
    with pytest.raises(InputError, match="2 films"):
        common_times([{1: Picture("0/1", 0.1)}, {2: Picture("1/2", 0.2)}])


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((1, 0, 0, 1), lambda image: image),
        ((-1, 0, 0, 1), np.fliplr),
        ((1, 0, 0, -1), np.flipud),
        ((-1, 0, 0, -1), lambda image: np.rot90(image, 2)),
        ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
        ((0, -1, 1, 0), np.rot90),
        ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
        ((0, -1, -1, 0), lambda image: np.rot90(image, 2).swapaxes(0, 1)),
    ],
)
def test_mirrored_and_turned_films(matrix: tuple[int, ...], shown: Callable[[Any], Any]) -> None:
    """(a, b, c, d) of a display matrix: x' = a x + c y, y' = b x + d y."""
    a, b, c, d = matrix
    values = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 14], np.int32) << 16
    how = orientation(SimpleNamespace(side_data={"DISPLAYMATRIX": values.tobytes()}))
    image = np.arange(12).reshape(3, 4)
    np.testing.assert_array_equal(oriented(image, how), shown(image))
    assert oriented_size((4, 3), how) == shown(image).shape[::-1]
