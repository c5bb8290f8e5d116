"""lapgs-prepare: films of phones, frames worth having, poses, and what it says of films that are of no use."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.films import Board, drawn, pose_errors, turn_film, walk, write_film
from PIL import Image

from lapgs_wgpu import prepare_cli
from lapgs_wgpu.command import beside
from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture import extract_all, prepare
from lapgs_wgpu.prepare.capture_folder import appearing
from lapgs_wgpu.prepare.extract import Extraction, Picture, common_moments, extract, images_per_second
from lapgs_wgpu.prepare.film import Film
from lapgs_wgpu.prepare.hdr import to_sdr
from lapgs_wgpu.prepare.reconstruct import _logging_to, neighbouring_pairs
from lapgs_wgpu.prepare_cli import prepare_command
from lapgs_wgpu.train.environment import resident_bytes

av = pytest.importorskip("av")
pycolmap = pytest.importorskip("pycolmap")


def noise(count: int, width: int = 64, height: int = 48, seed: int = 0) -> list[np.ndarray]:
    """Smooth pictures, each another one."""
    rng = np.random.default_rng(seed)
    return [np.kron(rng.integers(40, 216, (height // 8, width // 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)
            for _ in range(count)]  # fmt: skip


def seconds(path: Path) -> list[float]:
    return [frame.seconds for frame in Film(path).frames()]


# Films


def test_times_of_a_film_of_variable_rate(tmp_path: Path) -> None:
    times = [0.0, 0.033, 0.05, 0.2, 0.7, 0.71]
    path = write_film(tmp_path / "film.mkv", noise(6), times=times)
    assert seconds(path) == pytest.approx(times, abs=2e-3)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_frames_stand_upright(tmp_path: Path, degrees: int) -> None:
    picture = np.full((48, 64, 3), 30, np.uint8)
    picture[:16, :16] = 220  # the top left of what is stored
    path = write_film(tmp_path / "film.mp4", [picture] * 3)
    turn_film(path, degrees)
    film = Film(path)
    frames = [(frame.gray, frame.pixels(1000)) for frame in film.frames()]
    assert film.size == ((48, 64) if degrees != 180 else (64, 48))
    expected = np.rot90(picture, -degrees // 90)
    for gray, pixels in frames:
        assert pixels.shape == expected.shape
        assert np.abs(pixels.astype(int) - expected).max() < 40
        assert np.abs(gray - expected[..., 0]).mean() < 8


@pytest.mark.parametrize("degrees", [0, 90])
def test_pixels_that_are_not_square_become_so(tmp_path: Path, degrees: int) -> None:
    """As of cameras that record 1440x1080 to be shown as 1920x1080."""
    picture = np.full((48, 48, 3), 30, np.uint8)
    picture[:24, :24] = 220
    path = write_film(tmp_path / "film.mp4", [picture] * 3, aspect="4/3")
    if degrees:
        turn_film(path, degrees)
    film = Film(path)
    expected = np.rot90(np.repeat(picture[:, :, 0], 4, axis=1)[:, ::3], -degrees // 90)
    assert film.size == (64, 48)  # before the first frame says how it is turned
    for frame in film.frames():
        assert film.size == expected.shape[::-1]
        assert frame.pixels(1000).shape == (*expected.shape, 3)
        assert np.abs(frame.pixels(1000)[..., 0].astype(int) - expected).mean() < 5
        assert np.abs(frame.gray - expected).mean() < 8
        assert max(frame.pixels(32).shape) == 32


@pytest.mark.parametrize("aspect", ["1/100", "100"])
def test_an_impossible_shape_of_pixels_is_left_out_of_account(tmp_path: Path, aspect: str) -> None:
    assert Film(write_film(tmp_path / "film.mp4", noise(3), aspect=aspect)).size == (64, 48)


@pytest.mark.parametrize(("trc", "transfer"), [("arib-std-b67", "HLG"), ("smpte2084", "PQ")])
def test_hdr_films_look_like_ordinary_ones(tmp_path: Path, trc: str, transfer: str) -> None:
    """Gray of the reference white in 10 bits becomes (almost) white; half of its light sRGB's level for half."""
    signal = {"HLG": (0.75, 0.632), "PQ": (0.58, 0.508)}[transfer]
    for value, level in zip(signal, (233, 188), strict=True):
        deep = np.full((4, 4, 3), round(65535 * value), np.uint16)
        shown = to_sdr(deep, transfer)  # type: ignore[arg-type]
        assert np.abs(shown.astype(int) - level).max() <= 12, shown[0, 0]
    options = {"x264-params": f"colorprim=bt2020:transfer={trc}:colormatrix=bt2020nc"}
    path = write_film(tmp_path / "film.mkv", [np.full((48, 64, 3), 140, np.uint8)] * 3, options=options,
                      pix_fmt="yuv420p10le")  # fmt: skip
    for frame in Film(path).frames():
        pixels = frame.pixels(1000)
        assert pixels.dtype == np.uint8
        assert np.ptp(pixels) <= 3
        plain = 140 if transfer == "PQ" else 133
        assert abs(int(pixels[0, 0, 0]) - plain) > 5, "it was taken for an ordinary film"


def test_frames_without_time_stamps_are_counted(tmp_path: Path) -> None:
    """A bare H.264 stream has none."""
    path = tmp_path / "film.h264"
    write_film(path, noise(6), rate=25)
    film = Film(path)
    times = [frame.seconds for frame in film.frames()]
    assert np.diff(times) == pytest.approx(1 / 25)
    assert len(times) == 6


def test_a_film_cut_in_the_middle_of_a_packet(tmp_path: Path) -> None:
    """What comes before is used, and the user is told."""
    path = write_film(tmp_path / "film.mkv", noise(40), options={"g": "5"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 7])
    film = Film(path)
    count = len(list(film.frames()))
    assert 10 < count < 30
    assert any("damaged after" in note or "ends after" in note for note in film.notes), film.notes


def test_the_larger_of_two_streams_is_used(tmp_path: Path) -> None:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as file:
        streams = []
        for width, height in ((32, 32), (64, 48)):
            stream = file.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for stream in streams:
            for picture in noise(5, stream.width, stream.height):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            file.mux(stream.encode())
    film = Film(path)
    assert [frame.pixels(1000).shape for frame in film.frames()] == [(48, 64, 3)] * 5
    assert "2 video streams; number 2" in film.notes[0]
    assert len(film.notes) == 1


def test_a_film_of_8k(tmp_path: Path) -> None:
    """Its images are shrunk; a frame larger than the decoder may hold is refused by its header."""
    path = write_film(tmp_path / "film.mp4", [np.full((4320, 7680, 3), level, np.uint8) for level in (90, 160)],
                      options={"preset": "ultrafast", "crf": "40"})  # fmt: skip
    found = extract(Film(path), tmp_path / "images", "", 30, 1920, still=False)
    for picture in found.pictures:
        with Image.open(tmp_path / "images" / picture.name) as image:
            assert image.size == (1920, 1080)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lapgs_wgpu.prepare.film.LARGEST_FRAME", 4096 * 4096)
        with pytest.raises(InputError, match="frames of 7680x4320 pixels; 1 to 16,777,216 pixels a frame are allowed"):
            Film(path)


soak = pytest.mark.skipif("LAPGS_SOAK" not in os.environ, reason="takes half a minute: LAPGS_SOAK=1, or make soak")


@pytest.mark.parametrize("suffix", [pytest.param("mkv", marks=soak), "mp4"])
def test_a_film_of_more_than_4_gb(tmp_path: Path, suffix: str) -> None:
    """Of which a hole is most, where the system has such files: the film before it is read, and not all into memory."""
    path = write_film(tmp_path / f"film.{suffix}", noise(6))
    try:
        os.truncate(path, (1 << 32) + (1 << 20))
    except OSError as error:
        pytest.skip(f"this disk has no holes: {error}")
    if path.stat().st_blocks * 512 > 1 << 30:
        pytest.skip("this disk has no holes")
    before = resident_bytes()
    assert len(list(Film(path).frames())) == 6
    assert before is None or resident_bytes() - before < 200e6


def test_a_film_that_is_cut_gives_a_whole_capture_or_none(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The first half of a walk, cut in the middle of a packet."""
    pictures = [drawn(camera, 0, Board())[0] for camera in walk(2 * COUNT, WIDTH, HEIGHT)]
    path = write_film(tmp_path / "walk.mkv", pictures, rate=10, options={"g": "2"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 5])
    assert prepare_command([str(path), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "is damaged after" in said or "ends after" in said
    data = load_dataset(tmp_path / "out")
    assert COUNT - 3 <= len(data.train) + len(data.test) <= COUNT + 1


# Frames worth having


def test_the_sharpest_frame_of_each_span(tmp_path: Path) -> None:
    pictures = noise(12)
    soft = [p if i % 3 == 1 else np.full_like(p, p.mean()) // 2 + p // 2 for i, p in enumerate(pictures)]
    path = write_film(tmp_path / "film.mkv", soft, rate=30)
    found = extract(Film(path), tmp_path / "images", "", 10, 1000, still=False)
    assert [picture.name for picture in found.pictures] == [f"{round(100 * i + 33.3):08d}.jpg" for i in range(4)]
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == [p.name for p in found.pictures]
    still = extract(Film(path), tmp_path / "still", "cam00/", 10, 1000, still=True)
    assert [picture.name for picture in still.pictures] == [f"cam00/{100 * i:08d}.jpg" for i in range(4)]


def test_repeated_frames_are_left_out(tmp_path: Path) -> None:
    one, two, three = noise(3)
    path = write_film(tmp_path / "film.mkv", [one] * 6 + [two] * 6 + [three] * 3, rate=30)
    found = extract(Film(path), tmp_path / "images", "", 10, 1000, still=False)
    assert [round(10 * picture.seconds) for picture in found.pictures] == [0, 2, 4]
    assert found.repeated == 2
    assert "2 repeated left out" in str(found)


def test_large_frames_are_shrunk(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mkv", noise(3, 160, 96))
    frame = next(iter(Film(path).frames()))
    assert frame.pixels(80).shape == (48, 80, 3)


def test_a_long_film_gives_fewer_images_a_second(tmp_path: Path) -> None:
    film = Film(write_film(tmp_path / "film.mkv", noise(3)))
    film.seconds = 60.0
    assert images_per_second(film, None, still=False) == 5
    assert images_per_second(film, 12, still=False) == 12
    film.seconds = 5.0
    assert images_per_second(film, None, still=False) == 10
    assert images_per_second(film, None, still=True) == 30


def test_moments_of_several_films_are_common_ones() -> None:
    """Where one camera dropped images, and one has another rate."""

    def film(camera: int, seconds: list[float]) -> Extraction:
        return Extraction([Picture(f"cam{camera}/{s:.3f}", s, 1.0, 99.0) for s in seconds], 10.0, 99, still=True)

    even = [0.1 * i for i in range(20)]
    films = [film(0, even), film(1, [s for s in even if not 0.45 < s < 0.95]), film(2, [0.04 * i for i in range(48)])]
    moments = common_moments(films, 5)
    assert len(moments) == 5
    for pictures in moments:
        assert [picture.name[:4] for picture in pictures] == ["cam0", "cam1", "cam2"]
        seconds = [picture.seconds for picture in pictures]
        assert max(seconds) - min(seconds) < 1e-6, "0, 0.2, ... are those of all three"
        assert not 0.45 < seconds[0] < 0.95
    assert common_moments(films[:2], 99)[5][1].seconds == pytest.approx(1.0)


def test_films_of_several_cameras_have_one_rate(tmp_path: Path) -> None:
    films = [Film(write_film(tmp_path / f"{n}.mkv", noise(n), rate=30)) for n in (30, 36)]
    films[0].seconds, films[1].seconds = 12.0, 14.4  # as long ones say
    found = extract_all(films, tmp_path / "images", None, 64)
    assert found[0].fps == found[1].fps == 25
    stamps = [[picture.name.split("/")[1] for picture in each.pictures] for each in found]
    assert stamps[0] == stamps[1][: len(stamps[0])]


def test_a_film_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    blank = [np.full((48, 64, 3), 60 + 40 * i, np.uint8) for i in range(4)]
    path = write_film(tmp_path / "wall.mkv", blank, rate=10)
    assert "0 of 4 images could be placed" in refused([str(path), "--out", str(tmp_path / "out")], capsys)


def test_masks_that_are_missing_are_told_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = [str(tmp_path / "none.mp4"), "--out", str(tmp_path / "out"), "--masks", str(tmp_path / "typo")]
    assert "typo is not a folder; --masks needs one" in refused(arguments, capsys)


def test_pairs() -> None:
    names = [f"{i}" for i in range(100)]
    pairs = neighbouring_pairs(names)
    assert len(set(pairs)) == len(pairs) < 1200
    assert {int(b) - int(a) for a, b in pairs} == {1, 2, 3, 4, 5, 6, 9, 14, 20, 30, 46, 68}


# From films to a capture that trains


WIDTH, HEIGHT, COUNT = 200, 150, 10


def test_one_film(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    cameras = walk(COUNT, WIDTH, HEIGHT)
    path = write_film(tmp_path / "walk.mp4", [drawn(camera, 0, Board())[0] for camera in cameras], rate=10)
    out = tmp_path / "out"
    assert prepare_command([str(path), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert f"{COUNT} of {COUNT} cameras placed; {beside('lapgs-prepare')} --check " in said.out
    assert "10 images of 10 frames" in said.err
    times = json.loads((out / "times.json").read_text())
    assert times == {f"{100 * i:08d}.jpg": i / 10 for i in range(COUNT)}
    assert sorted(child.name for child in out.iterdir()) == ["images", "masks", "report.html", "sparse", "times.json"]
    data = load_dataset(out)
    found = {f"{round(view.time * (COUNT - 1))}": view.camera.position for view in (*data.train, *data.test)}
    errors = pose_errors(found, {f"{i}": camera.position for i, camera in enumerate(cameras)})
    assert len(errors) == COUNT
    assert errors.max() < 0.03


def test_films_of_still_cameras(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Of different lengths, with a board that moves."""
    cameras, board = walk(4, WIDTH, HEIGHT), Board(0.4)
    films = []
    for number, camera in enumerate(cameras):
        pictures = [drawn(camera, t, board)[0] for t in np.linspace(0, 1, 4)]
        films.append(write_film(tmp_path / f"{number}.mp4", pictures[: 3 if number == 2 else 4] * 2, rate=10))
    out = tmp_path / "out"
    assert prepare_command([*map(str, films), "--out", str(out), "--fps", "10"]) == 0
    said = capsys.readouterr()
    assert f"4 of 4 cameras placed; {beside('lapgs-prepare')} --check " in said.out
    assert "the films are 0.50 to 0.70 s long; all are cut to 0.50 s" in said.err
    assert len(json.loads((out / "times.json").read_text())) == 4 * 6
    data = load_dataset(out)
    assert len(data.cameras) == 3
    found = {"0": data.test[0].camera.position} | {f"{i + 1}": c.position for i, c in enumerate(data.cameras)}
    assert pose_errors(found, {f"{i}": camera.position for i, camera in enumerate(cameras)}).max() < 0.05


# What is refused


def refused(arguments: list[str], capsys: pytest.CaptureFixture) -> str:
    assert prepare_command(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("lapgs-prepare: ")
    return lines[-1]


@pytest.mark.parametrize(
    ("pictures", "words"),
    [
        (noise(1), ["has 1 frames"]),
        ([np.zeros((48, 64, 3), np.uint8)] * 8, ["is black", "of 255 levels"]),
        (noise(1) * 10, ["gives 1 images", "repeat"]),
        (noise(12), ["of 4 images could be placed", "film slower"]),
    ],
    ids=["one frame", "black", "still", "nothing in common"],
)
def test_films_of_no_use(
    pictures: list[np.ndarray], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = write_film(tmp_path / "film.mkv", pictures, rate=30)
    said = refused([str(path), "--out", str(tmp_path / "out")], capsys)
    for word in words:
        assert word in said
    assert [child.name for child in tmp_path.iterdir()] == ["film.mkv"]


def test_what_is_no_film(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "film.mp4").write_text("hello")
    out = ["--out", str(tmp_path / "out")]
    assert "film.mp4 is not a readable film" in refused([str(tmp_path / "film.mp4"), *out], capsys)
    assert "is a folder; name the film" in refused([str(tmp_path), *out], capsys)
    assert "none.mp4 does not exist" in refused([str(tmp_path / "none.mp4"), *out], capsys)
    assert not (tmp_path / "out").exists()


def test_cameras_of_different_sizes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    films = [write_film(tmp_path / f"{w}.mkv", noise(4, w, 48)) for w in (64, 80)]
    assert "80x48 pixels and" in refused([*map(str, films), "--out", str(tmp_path / "out")], capsys)


def test_options_out_of_range(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    film = str(write_film(tmp_path / "film.mkv", noise(3)))
    out = ["--out", str(tmp_path / "out")]
    assert "--fps must be above 0" in refused([film, *out, "--fps", "0"], capsys)
    assert "--size must be 64 to 8192" in refused([film, *out, "--size", "10"], capsys)


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    film = write_film(tmp_path / "film.mkv", noise(3))
    assert "not an empty folder" in refused([str(film), "--out", str(tmp_path)], capsys)
    assert film.is_file()


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "image.jpg")

    film = write_film(tmp_path / "film.mkv", noise(3))
    monkeypatch.setattr(Image.Image, "save", full)
    assert "No space left on device" in refused([str(film), "--out", str(tmp_path / "out")], capsys)
    assert [child.name for child in tmp_path.iterdir()] == ["film.mkv"]


def finish(out: Path) -> None:
    with appearing(out) as folder:
        (folder / "images").mkdir()
        (folder / "times.json").write_text("{}")


@pytest.mark.parametrize("kind", ["new", "empty", "present", "link"])
def test_a_capture_appears_where_it_was_asked_for(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "parent" / "out"
    if kind != "new":
        out.mkdir(parents=True)
        out.parent.chmod(0o555)  # as that of a mount may be
    if kind == "present":
        monkeypatch.chdir(out)
    elif kind == "link":
        (tmp_path / "link").symlink_to(out)
    finish({"present": Path("."), "link": tmp_path / "link"}.get(kind, out))
    out.parent.chmod(0o755)
    assert sorted(child.name for child in out.iterdir()) == ["images", "times.json"]


def test_what_is_finished_is_never_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(source: Path, target: Path) -> None:
        if source.name == "times.json":
            raise OSError(5, "Input/output error")
        replace(source, target)

    out, replace = tmp_path / "out", os.replace
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", fail)
        with pytest.raises(InputError, match=r"\.finished holds the finished capture"):
            finish(out)
    assert (out / ".finished" / "times.json").is_file()
    with pytest.raises(InputError, match="not an empty folder"):
        finish(out)
    assert (out / ".finished" / "times.json").is_file()


def test_two_processes_do_not_write_to_one_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with appearing(out) as folder:
        (folder / "images").mkdir()
        with pytest.raises(InputError, match="written by another lapgs-prepare"):
            finish(out)
        assert (folder / "images").is_dir()
    assert [child.name for child in out.iterdir()] == ["images"]


def test_files_of_the_desktop_fill_no_folder(tmp_path: Path) -> None:
    for name in (".DS_Store", "._out", "desktop.ini", "Thumbs.db"):
        (tmp_path / name).touch()
    finish(tmp_path)
    assert (tmp_path / "times.json").is_file()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="lists open files by Linux's /proc")
def test_the_log_of_colmap_is_closed(tmp_path: Path) -> None:
    """Windows moves no folder in which a file is open."""
    with _logging_to(pycolmap, tmp_path):
        for number in range(40):  # after a file that could not be opened, glog tries again at some later message
            pycolmap.logging.info(f"message {number}")
        assert list(tmp_path.glob("colmap.log.*"))
    opened = [os.readlink(file) for file in Path("/proc/self/fd").iterdir() if os.path.lexists(file)]
    assert not [file for file in opened if file.startswith(str(tmp_path))]


@pytest.mark.parametrize("minutes", [[], ["--minutes", "3.0"]])
def test_macos_trains_in_a_process_of_its_own(
    minutes: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two libraries with an OpenMP each do not get along there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(prepare_cli, "_convert", lambda given, out: None)
    called: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda program, command: called.append([program, *command]))
    assert prepare_command(["film.mp4", "--out", "out", "--train", *minutes]) == 0
    command = [sys.executable, "-m", "lapgs_wgpu.prepare_cli", "--check", "out", "--train", *minutes]
    assert called == [[sys.executable, *command]]


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".unfinished").mkdir()
    (tmp_path / ".unfinished" / "old").touch()
    (tmp_path / ".lock").touch()
    finish(tmp_path)
    assert sorted(child.name for child in tmp_path.iterdir()) == ["images", "times.json"]


@pytest.mark.parametrize("missing", ["av", "pycolmap"])
def test_without_the_extra(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    film = write_film(tmp_path / "film.mkv", noise(3))
    monkeypatch.setitem(sys.modules, missing, None)
    assert 'pip install "lapgs-wgpu[prepare]"' in refused([str(film), "--out", str(tmp_path / "out")], capsys)


def test_no_other_program_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert shutil.which("ffmpeg") is None
    film = write_film(tmp_path / "film.mkv", noise(8))
    with pytest.raises(InputError, match="could be placed"):
        prepare([film], tmp_path / "out")
