"""benchmarks/run_table: what a spec asks for, which runs it trains, and the table of their results."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import run_table
from synthetic import write_synthetic

from lapgs_wgpu import command
from lapgs_wgpu.train.presets import load_config, write_toml

ROOT = Path(__file__).parents[1]
SPEC = """
preset = "tiny"
seeds = [3, 5]
[common]
schedule.steps = 3
points.count = 50
field.width = 8
field.static = { levels = 1, finest = [8, 8, 8] }
[scenes]
toys = "toys"
others = { folder = "toys", data.size = 12 }
[rows]
static = { method = "static" }
grid4d = { method = "grid4d", scenes = ["toys"], seeds = [5] }
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_synthetic(folder / "toys", size=24, train_views=3, test_views=2)
    return folder


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    (tmp_path / "spec.toml").write_text(SPEC)
    return tmp_path / "spec.toml"


def make(spec: Path, data: Path, *more: str) -> int:
    arguments = [str(spec), "--data", str(data), "--out", str(spec.parent / "out"), *more]
    return command.guarded("run_table", run_table.main, arguments)


def test_a_spec_names_every_run_with_its_configuration(spec: Path) -> None:
    spec.write_text(SPEC + 'bare = { ablate = ["lap", "dy"], seeds = [3], scenes = ["toys"] }\n')
    runs = {str(run): run.config for run in run_table.read_spec(spec)}
    assert list(runs) == [
        "toys, static, seed 3", "toys, static, seed 5", "toys, grid4d, seed 5", "toys, bare, seed 3",
        "others, static, seed 3", "others, static, seed 5",
    ]  # fmt: skip
    config = runs["others, static, seed 5"]
    assert (config.seed, config.data.size, config.schedule.steps, config.field.kind) == (5, 12, 3, "static")
    grid4d, bare = runs["toys, grid4d, seed 5"], runs["toys, bare, seed 3"]
    assert (grid4d.data.size, grid4d.field.kind, grid4d.field.static.levels) == (200, "grid4d", 1)
    assert (grid4d.loss.pyramid, grid4d.density.split) == (0, "plain")
    assert grid4d.field.static.table_log2 == load_config("tiny").field.static.table_log2
    assert (bare.loss.pyramid, bare.loss.dynamics, bare.density.split) == (0, 0, "adaptive")


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "tables").glob("*.toml")), ids=lambda file: file.name)
def test_the_committed_specs_are_valid(file: Path) -> None:
    assert run_table.read_spec(file)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Instead of training, leaves a run folder with made-up figures, and notes here which run it was."""
    done: list[str] = []

    def train(run: run_table.Run, data: Path, out: Path, *_: object) -> None:
        done.append(str(run))
        folder = run_table.run_folder(out, run)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.toml").write_text(write_toml(dataclasses.asdict(run.config)))
        (folder / "metrics.json").write_text(json.dumps(metrics(run.seed, run.config.schedule.steps)))

    monkeypatch.setattr(run_table, "_train", train)
    return done


def metrics(seed: int, steps: int) -> dict[str, Any]:
    figures = {"psnr": 20.0 + seed, "ssim": 0.5, "ms_ssim": "not available", "lpips": "not available"}
    training = {"steps": steps, "seconds": 6.0}
    return figures | {"gaussians": 50, "size": [24, 24], "views": [{}, {}], "training": training, "environment": {}}


def test_finished_runs_are_skipped_others_trained_again(
    spec: Path, data: Path, trained: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = spec.parent / "out"
    assert make(spec, data) == 0
    assert len(trained) == 5
    shown = capsys.readouterr().out
    assert "| toys | static | 2 | 24.00 | 1.41 | 0.5000 | 50 | 6 |" in shown
    assert len(json.loads((out / "results.json").read_text())) == 5
    trained.clear()
    assert make(spec, data) == 0
    assert capsys.readouterr().out == shown
    assert not trained
    (out / "toys/static/seed3/metrics.json").unlink()
    (out / "toys/static/seed5/metrics.json").write_text("{")
    (out / "others/static/seed3/metrics.json").write_text(json.dumps(metrics(3, 2)))  # measured before its last step
    spec.write_text(SPEC.replace("grid4d = {", "grid4d = { field.width = 16,"))
    assert make(spec, data) == 0
    expected = ["toys, static, seed 3", "toys, static, seed 5", "toys, grid4d, seed 5", "others, static, seed 3"]
    assert trained == expected


def result(scene: str, row: str, seed: int, psnr: float, **more: Any) -> run_table.Result:
    return {"scene": scene, "row": row, "seed": seed, **metrics(0, 3), "psnr": psnr, "seconds": 10.0, **more}


def test_means_over_the_scenes_weigh_scenes_alike() -> None:
    results = [
        result("a", "x", 0, 20.0), result("a", "x", 1, 22.0, lpips=0.25), result("a", "x", 2, 24.0),
        result("b", "x", 0, 30.0), result("b", "x", 1, 34.0), result("b", "y", 0, 10.0),
    ]  # fmt: skip
    lines = run_table.markdown(results).splitlines()
    assert lines[0] == "| scene | row | seeds | PSNR | ± | SSIM | LPIPS | Gaussians | seconds |"
    assert lines[2] == "| a | x | 3 | 22.00 | 2.00 | 0.5000 | - | 50 | 10 |"
    assert lines[4] == "| b | y | 1 | 10.00 | - | 0.5000 | - | 50 | 10 |"
    assert lines[5:] == ["| mean | x | 3 | 27.00 | 2.12 | 0.5000 | - | 50 | 10 |"]  # of 22 and 32; seeds 25 and 28
