"""lapgs-prepare: what it asks of ffmpeg and colmap, and what it says when they are missing or fail."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from helpers.captures import cameras, moved, write_video

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.prepare import extract, prepare_command

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")

# Does what colmap does to the disk, and notes how it was called.
FAKE = """#!/usr/bin/env python3
import pathlib, shutil, sys
words = sys.argv[1:]
with open({log!r}, "a") as file:
    file.write(" ".join(words) + "\\n")
if "-h" in words:
    print("  --" + ("FeatureExtraction" if "extractor" in words[0] else "SiftMatching") + ".use_gpu arg (=1)")
elif words[0] == {failing!r}:
    print("it says why")
    sys.exit(1)
elif words[0] == "mapper":
    out = pathlib.Path(words[words.index("--output_path") + 1])
    for name in {models!r}:
        shutil.copytree(pathlib.Path({source!r}) / name, out / name)
"""


@pytest.fixture
def films(device: Device, tmp_path: Path) -> list[Path]:
    """Two cameras, 25 pictures a second for 0.4 seconds."""
    pytest.importorskip("av")
    paths = []
    for i, camera in enumerate(cameras(2)):
        paths.append(tmp_path / f"film{i}.mp4")
        write_video(paths[-1], [moved(frame).drawn(camera, device) for frame in range(12)])
    return paths


def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, failing: str = "", models: dict[str, int]) -> Path:
    """A colmap that finds models of so many pictures, by name; returns its log."""
    log, source, programs = tmp_path / "calls.txt", tmp_path / "models", tmp_path / "programs"
    programs.mkdir()
    for name, count in models.items():
        (source / name).mkdir(parents=True)
        (source / name / "cameras.txt").write_text("1 PINHOLE 64 48 66 66 32 24\n")
        lines = "".join(f"{i + 1} 1 0 0 0 0 0 0 1 {i}.png\n\n" for i in range(count))
        (source / name / "images.txt").write_text(lines)
        (source / name / "points3D.txt").write_text("")
    text = FAKE.format(log=str(log), failing=failing, models=list(models), source=str(source))
    (programs / "colmap").write_text(text)
    (programs / "colmap").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    return log


@needs_ffmpeg
def test_pictures_carry_their_time(films: list[Path], tmp_path: Path) -> None:
    """30 pictures a second: each one's own time, not that of an even clock."""
    ffmpeg = shutil.which("ffmpeg")
    assert ffmpeg is not None
    every = extract(ffmpeg, films[0], tmp_path / "every", 1000)
    assert [int(path.stem) for path in every] == [round(1000 * i / 30) for i in range(12)]
    third = extract(ffmpeg, films[0], tmp_path / "third", 10)
    assert [int(path.stem) for path in third] == [0, 100, 200, 300]


@needs_ffmpeg
def test_one_film(
    films: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    log = fake(tmp_path, monkeypatch, models={"0": 1, "1": 3})
    out = tmp_path / "out"
    assert prepare_command([str(films[0]), "--out", str(out)]) == 0
    assert json.loads((out / "times.json").read_text()) == {f"{i:08d}.jpg": i / 1000 for i in (0, 100, 200, 300)}
    steps = [line for line in log.read_text().splitlines() if "-h" not in line]
    assert [step.split()[0] for step in steps] == ["feature_extractor", "sequential_matcher", "mapper"]
    assert "--FeatureExtraction.use_gpu 0" in steps[0]
    assert "--SiftMatching.use_gpu 0" in steps[1]
    assert "OPENCV" in steps[0]
    assert len((out / "sparse/0/images.txt").read_text().split("\n\n")) == 4, "the larger model"
    assert "3 of 4" in capsys.readouterr().out


@needs_ffmpeg
def test_films_of_still_cameras(films: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = fake(tmp_path, monkeypatch, models={"0": 2})
    out = tmp_path / "out"
    assert prepare_command([*map(str, films), "--out", str(out)]) == 0
    assert (out / "colmap/list.txt").read_text() == "cam00/00000000.jpg\ncam01/00000000.jpg\n"
    assert "exhaustive_matcher" in log.read_text()
    assert sorted(json.loads((out / "times.json").read_text()))[4] == "cam01/00000000.jpg"


@needs_ffmpeg
@pytest.mark.parametrize(
    ("failing", "models", "words"),
    [
        ("mapper", {"0": 4}, ["colmap mapper failed with code 1", "it says why", "overlap too little", "colmap.log"]),
        ("feature_extractor", {"0": 4}, ["colmap feature_extractor failed", "it says why"]),
        ("", {}, ["found no cameras", "colmap.log"]),
        ("", {"0": 1}, ["registered 1 of 4 images"]),
    ],
)
def test_failures_of_colmap(
    failing: str,
    models: dict[str, int],
    words: list[str],
    films: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    fake(tmp_path, monkeypatch, failing=failing, models=models)
    assert prepare_command([str(films[0]), "--out", str(tmp_path / "out")]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    for word in words:
        assert word in last


@needs_ffmpeg
def test_a_film_that_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    fake(tmp_path, monkeypatch, models={})
    (tmp_path / "film.mp4").write_text("hello")
    assert prepare_command([str(tmp_path / "film.mp4"), "--out", str(tmp_path / "out")]) == 2
    assert "film.mp4: ffmpeg failed" in capsys.readouterr().err


@pytest.mark.parametrize("missing", ["ffmpeg", "colmap"])
def test_programs_that_are_missing(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "film.mp4").write_text("hello")
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in {"ffmpeg", "colmap"} - {missing}:
        (programs / name).write_text("#!/bin/sh\n")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(programs))
    assert prepare_command([str(tmp_path / "film.mp4"), "--out", str(tmp_path / "out")]) == 2
    assert f"the program {missing} is not installed" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "film.mp4").write_text("hello")
    assert prepare_command([str(tmp_path / "film.mp4"), "--out", str(tmp_path)]) == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert prepare_command([str(tmp_path / "none.mp4"), "--out", str(tmp_path / "out")]) == 2
    assert "none.mp4 does not exist" in capsys.readouterr().err
