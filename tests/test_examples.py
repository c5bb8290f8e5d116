"""The programs in examples/, in the smallest size."""

import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.scene_files import moving_scene

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig

EXAMPLES = Path(__file__).parents[1] / "examples"
ARGUMENTS = {
    "train": ["--steps", "30"],
    "own_field": ["--steps", "30"],
    "own_loss": ["--steps", "60"],
    "own_density": ["--steps", "230", "--budget", "4000"],
    "render_path": ["--frames", "4", "--size", "48"],
    "fit_image": ["--steps", "60", "--gaussians", "400", "--size", "48"],
    "export_web": [],
    "simple_trainer": ["--steps", "50", "--gaussians", "800"],
}


def run(name: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str = "--data") -> Any:
    """What an example's main returns. option: before `data`, a capture, an image or a checkpoint."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *([option] if option else []), str(data), *ARGUMENTS[name]])
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]()


def test_all_examples_are_tested() -> None:
    assert {file.stem for file in EXAMPLES.glob("*.py")} == set(ARGUMENTS)


def test_train(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = run("train", data, tmp_path, monkeypatch)
    assert metrics["psnr"] > 10
    assert (tmp_path / "scene.ply").stat().st_size > 1e5


def test_own_field(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    assert run("own_field", data, tmp_path, monkeypatch) > 10
    moved = float(capsys.readouterr().out.split("moves by ")[1].split()[0])
    assert 0 < moved < 5


def test_own_loss(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terms = run("own_loss", data, tmp_path, monkeypatch)
    assert all(terms[name] > 0 for name in ("edges", "needles"))


@pytest.mark.nightly
def test_own_density(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("own_density", data, tmp_path, monkeypatch) <= 4000


@pytest.fixture
def checkpoint(device: Device, tmp_path: Path) -> Path:
    moving_scene(device, FieldConfig(kind="grid4d", width=8)).save(tmp_path / "a.ply")
    return tmp_path / "a.ply"


def test_render_path(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = run("render_path", checkpoint, tmp_path, monkeypatch, option="")
    assert [frame.size for frame in frames] == [(48, 48)] * 4
    assert np.std(frames[0]) > 5
    assert np.any(np.asarray(frames[0]) != frames[2])
    assert (tmp_path / "path.webp").read_bytes()[:4] == b"RIFF"


@pytest.mark.nightly
def test_fit_image(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = next((data / "train").glob("*.png"))
    assert run("fit_image", image, tmp_path, monkeypatch, option="--image") > 20
    assert (tmp_path / "fitted.png").is_file()


def test_simple_trainer(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("simple_trainer", data, tmp_path, monkeypatch) > 13


def test_export_web(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("export_web", checkpoint, tmp_path, monkeypatch, option="")
    assert "<title>scene</title>" in (tmp_path / "scene.html").read_text(encoding="utf-8")
