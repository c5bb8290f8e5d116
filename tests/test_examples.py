"""The programs in examples/, in the smallest size."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
ARGUMENTS = {
    "train": ["--steps", "60"],
    "own_field": ["--steps", "60"],
    "own_loss": ["--steps", "60"],
    "own_density": ["--steps", "230", "--budget", "4000"],
}


def run(name: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--data", str(data), *ARGUMENTS[name]])
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
    assert all(terms[name] > 0 for name in ("edges", "charbonnier", "needles"))


def test_own_density(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("own_density", data, tmp_path, monkeypatch) <= 4000
