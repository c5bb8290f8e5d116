"""lapgs-prepare: from films to captures that open, and what it says of films that are of no use."""

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.films import Board, drawn, noise_pictures, pose_errors, walk, write_film
from PIL import Image

from lapgs_wgpu import prepare_cli
from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.prepare.capture import appearing, prepare
from lapgs_wgpu.prepare.poses import neighbouring_pairs
from lapgs_wgpu.prepare_cli import prepare_command

pytest.importorskip("av")
pytest.importorskip("pycolmap")

SIZE, COUNT = (200, 150), 10


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten images of noise."""
    return write_film(tmp_path_factory.mktemp("film") / "film.mkv", noise_pictures(12))


def test_one_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> None:
    """Which is cut in the middle of a packet; no other program is needed."""
    monkeypatch.setenv("PATH", "")
    cameras = walk(2 * COUNT, *SIZE)
    path = write_film(
        tmp_path / "walk.mkv", [drawn(camera, 0, Board())[0] for camera in cameras], rate=10, options={"g": "2"}
    )
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 5])
    out = tmp_path / "out"
    assert prepare_command([str(path), "--out", str(out)]) == 0
    said = capfd.readouterr()
    assert not re.findall(r"^[IWEF]\d{8} ", said.err, re.MULTILINE), "COLMAP's log"
    assert said.out.count("(wanted: ") == 4
    times = json.loads((out / "times.json").read_text())
    assert COUNT - 3 <= len(times) <= COUNT + 1
    assert times == {f"{100 * i:08d}.jpg": i / 10 for i in range(len(times))}
    assert sorted(child.name for child in out.iterdir()) == ["images", "masks", "report.html", "sparse", "times.json"]
    for folder, suffix in (("images", ".jpg"), ("masks", ".png")):
        assert {file.stem + suffix for file in (out / folder).iterdir()} == {Path(n).stem + suffix for n in times}
    data = load_dataset(out)
    found = {Path(view.source).name: view.camera.position for view in (*data.train, *data.test)}
    errors = pose_errors(found, {f"{100 * i:08d}.jpg": camera.position for i, camera in enumerate(cameras)})
    assert len(errors) == len(times)
    assert errors.max() < 0.03
    assert prepare_command([str(path), "--out", str(tmp_path / "again")]) == 0
    models = [sorted((folder / "sparse" / "0").iterdir()) for folder in (out, tmp_path / "again")]
    assert [one.read_bytes() for one in models[0]] == [other.read_bytes() for other in models[1]]


def test_films_of_still_cameras(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """Of different lengths, with a board that moves."""
    cameras, board = walk(4, *SIZE), Board(0.4)
    films = []
    for number, camera in enumerate(cameras):
        pictures = [drawn(camera, t, board)[0] for t in np.linspace(0, 1, 4)]
        films.append(write_film(tmp_path / f"{number}.mp4", pictures[: 3 if number == 2 else 4] * 2, rate=10))
    out = tmp_path / "out"
    prepare(films, out, fps=10)
    assert "24 images, 4 of 4 cameras placed" in capfd.readouterr().out
    assert len(json.loads((out / "times.json").read_text())) == 4 * 6
    data = load_dataset(out)
    assert len(data.cameras) == 3
    found = {"0": data.test[0].camera.position} | {f"{i + 1}": c.position for i, c in enumerate(data.cameras)}
    assert pose_errors(found, {f"{i}": camera.position for i, camera in enumerate(cameras)}).max() < 0.05


def test_pairs() -> None:
    pairs = neighbouring_pairs([f"{i}" for i in range(100)])
    assert len(set(pairs)) == len(pairs) < 1200
    assert {int(b) - int(a) for a, b in pairs} == {1, 2, 3, 4, 5, 6, 9, 14, 20, 30, 46, 68}


# What is refused


@pytest.mark.parametrize(
    ("pictures", "words"),
    [
        (noise_pictures(1), "has 1 frames"),
        ([np.zeros((48, 64, 3), np.uint8)] * 8, "is black"),
        (noise_pictures(1) * 10, "1 images.*6 repeated"),
        (noise_pictures(12), r"of \d+ images could be placed"),
        ([np.full((48, 64, 3), 60 + 15 * i, np.uint8) for i in range(12)], "0 of 8 images could be placed.*texture"),
    ],
    ids=["one frame", "black", "still", "nothing in common", "a wall"],
)
def test_films_of_no_use(pictures: list[np.ndarray], words: str, tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mkv", pictures)
    with pytest.raises(InputError, match=words):
        prepare([path], tmp_path / "out")
    kept = {"images", "refused.txt"} if "placed" in words else set()
    assert {child.name for child in tmp_path.glob("out/*")} >= kept


def test_what_a_refusal_has_found_stays(film: Path, tmp_path: Path) -> None:
    """And the next run goes on there."""
    out = tmp_path / "out"
    assert prepare_command([str(film), "--out", str(out)]) == 2
    why = (out / "refused.txt").read_text()
    page = (out / "report.html").read_text()
    assert re.search(r"\d+ of 8 images could be placed", why)
    assert why[:40] in page
    assert page.count("<img ") >= 2
    cameras = walk(4, *SIZE)
    still = [write_film(tmp_path / f"{i}.mp4", [drawn(camera, 0, Board())[0]] * 6) for i, camera in enumerate(cameras)]
    prepare(still, out)
    assert sorted(child.name for child in out.iterdir()) == ["images", "sparse", "times.json"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("film.mp4", ""),
        ("folder", ""),
        ("none.mp4", ""),
        ("film.zip", ""),
        ("*.webp", ""),
        ("phone", "/1.heic.*pillow-heif"),
    ],
)
def test_what_is_no_film(name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("folder", "phone"):
        (tmp_path / folder).mkdir()
    for file in ("film.mp4", "film.zip", "phone/1.heic", "phone/2.heic"):
        (tmp_path / file).write_text("hello")
    monkeypatch.setattr("lapgs_wgpu.prepare.inputs.HEIC", "no_such_module")
    with pytest.raises(InputError, match=re.escape(name) + words):
        prepare([tmp_path / name], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_full_disk(film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "image.jpg")

    monkeypatch.setattr(Image.Image, "save", full)
    assert prepare_command([str(film), "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("missing", ["av", "pycolmap", "cv2"])
def test_without_the_extra(missing: str, film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(InputError, match=r"lapgs-wgpu\[prepare\]"):
        prepare([film], tmp_path / "out")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["film.mp4", "--check", "DIR"], "--check"),
        (["--check", "DIR", "--fps", "3"], "--check"),
        (["--out", "DIR"], "films"),
        (["film.mp4"], "--out"),
        (["film.mp4", "--out", "DIR", "--fps", "0"], "--fps"),
        (["film.mp4", "--out", "DIR", "--minutes", "3"], "--minutes"),
        (["film.mp4", "--out", "DIR", "--train", "--minutes", "nan"], "--minutes"),
    ],
)
def test_options_that_do_not_go_together(arguments: list[str], named: str, capsys: pytest.CaptureFixture) -> None:
    assert prepare_command(arguments) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("minutes", [[], ["--minutes", "3.0"]])
def test_macos_trains_in_a_process_of_its_own(
    minutes: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two libraries with an OpenMP each do not get along there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(prepare_cli, "_convert", lambda given: None)

    def replaced(program: str, command: list[str]) -> None:
        assert program == command[0] == sys.executable
        assert command[1:] == ["-m", "lapgs_wgpu.prepare_cli", "--check", "out", "--train", *minutes]
        raise SystemExit(7)

    monkeypatch.setattr(os, "execv", replaced)
    with pytest.raises(SystemExit, match="7"):
        prepare_command(["film.mp4", "--out", "out", "--train", *minutes])


# The folder


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
        with pytest.raises(InputError, match=r"\.unfinished"):
            finish(out)
    for _ in range(2):
        assert (out / ".unfinished" / "times.json").is_file()
        with pytest.raises(InputError, match="out"):  # which is not empty
            finish(out)


def test_two_processes_do_not_write_to_one_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with appearing(out) as folder:
        (folder / "images").mkdir()
        with pytest.raises(InputError, match="lapgs-prepare"):
            finish(out)
        assert (folder / "images").is_dir()
    assert [child.name for child in out.iterdir()] == ["images"]


def test_what_does_not_fill_a_folder(tmp_path: Path) -> None:
    """Files of the desktop, and what a killed process left."""
    for name in (".DS_Store", "._out", "desktop.ini", "Thumbs.db", ".lock", ".unfinished/old"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    finish(tmp_path)
    assert (tmp_path / "times.json").is_file()
    assert not (tmp_path / ".unfinished").exists()
