"""lapgs-table: what a spec asks for, which runs it trains, and the table that it leaves."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest
from helpers.interrupts import handled

from lapgs_wgpu import cli, command, table_cli
from lapgs_wgpu.data import motion_writer, synthetic
from lapgs_wgpu.data.motion_scenes import MotionScene
from lapgs_wgpu.data.synthetic import write_synthetic
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.train import plots, table
from lapgs_wgpu.train.presets import load_config, write_toml
from lapgs_wgpu.train.run_folder import locked_folder
from lapgs_wgpu.train.table_results import (
    Result,
    Results,
    markdown,
    merge_results,
    read_results,
    seconds_to,
    write_results,
)
from lapgs_wgpu.train.table_spec import Run, RunKey, fingerprint, read_spec

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
static = { field.kind = "static" }
grid4d = { method = "grid4d", scenes = ["toys"], seeds = [5] }
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_synthetic(folder / "toys", size=24, train_views=3, test_views=2)
    return folder


@pytest.fixture
def spec_file(tmp_path: Path) -> Path:
    file = tmp_path / "spec.toml"
    file.write_text(SPEC)
    return file


def result(scene: str = "a", row: str = "x", seed: int = 0, **values: object) -> Result:
    whole = Result(
        scene, row, seed, "f", 20.0, 0.5, 1000, 300, 10.0, (24, 24), 2, {"field": {"kind": "static"}}, {"torch": "2"}
    )
    return dataclasses.replace(whole, **values)  # type: ignore[arg-type]


# The spec


def test_a_spec_names_every_run_with_its_configuration(spec_file: Path) -> None:
    runs = {run.key: run for run in read_spec(spec_file).runs}
    assert [tuple(key) for key in runs] == [
        ("toys", "static", 3), ("toys", "static", 5), ("toys", "grid4d", 5),
        ("others", "static", 3), ("others", "static", 5),
    ]  # fmt: skip
    config = runs[RunKey("others", "static", 5)].config
    assert (config.seed, config.data.size, config.schedule.steps, config.field.kind) == (5, 12, 3, "static")
    config = runs[RunKey("toys", "grid4d", 5)].config
    assert (config.data.size, config.field.kind, config.field.static.levels) == (200, "grid4d", 1)
    assert config.field.static.table_log2 == load_config("tiny").field.static.table_log2
    assert runs[RunKey("others", "static", 5)].overrides["data"] == {"size": 12}


def test_rows_may_name_a_method_and_parts_to_leave_out(tmp_path: Path) -> None:
    (tmp_path / "spec.toml").write_text(SPEC + 'bare = { ablate = ["lap", "dy"], seeds = [3], scenes = ["toys"] }\n')
    runs = {run.key: run for run in read_spec(tmp_path / "spec.toml").runs}
    bare, grid4d = runs[RunKey("toys", "bare", 3)].config, runs[RunKey("toys", "grid4d", 5)].config
    assert (bare.loss.pyramid, bare.loss.dynamics_mode, bare.density.split) == (0, "off", "adaptive")
    assert (grid4d.loss.pyramid, grid4d.density.split) == (0, "plain")
    assert runs[RunKey("toys", "bare", 3)].overrides["ablate"] == ["lap", "dy"]


def test_the_fingerprint_is_that_of_the_training_not_of_the_machine(tmp_path: Path) -> None:
    config = load_config("tiny")
    moved = dataclasses.replace(config, data=dataclasses.replace(config.data, path="/elsewhere"))
    assert fingerprint(moved) == fingerprint(config)
    assert fingerprint(dataclasses.replace(config, seed=1)) != fingerprint(config)
    exposed = dataclasses.replace(config.exposure, enabled=True)
    assert fingerprint(dataclasses.replace(config, exposure=exposed)) != fingerprint(config)
    assert fingerprint(dataclasses.replace(config, decoder="device")) == fingerprint(config), "as a GPU has it"
    kept = dataclasses.replace(config.cameras, refine="off")
    assert fingerprint(dataclasses.replace(config, cameras=kept)) != fingerprint(config)
    (tmp_path / "again.toml").write_text(write_toml(dataclasses.asdict(config)))
    assert fingerprint(load_config(str(tmp_path / "again.toml"))) == fingerprint(config)


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "tables").glob("*.toml")), ids=lambda file: file.name)
def test_the_committed_specs_are_valid(file: Path) -> None:
    assert read_spec(file).runs


MISTAKES = {
    "motion scene": ('toys = "toys"', 'toys = "motion:pth=2"', "scenes.toys: motion:pth=2: there is no key pth; did"),
    "no TOML": ('preset = "tiny"', "preset = tiny", "cannot be read as TOML"),
    "unknown key": ("seeds = [3, 5]", "sedes = [3, 5]", "no key sedes; did you mean seeds?"),
    "no seeds": ("seeds = [3, 5]\n", "", "seeds must be a list of different whole numbers from 0 up, got None"),
    "a seed twice": ("seeds = [3, 5]\n", "seeds = [3, 3]\n", "different whole numbers"),
    "unknown preset": ('"tiny"', '"tinny"', "did you mean tiny?"),
    "unknown key of the configuration": ("width", "widht", "no key field.widht; did you mean field.width?"),
    "wrong value": ("steps = 3", 'steps = "3"', "schedule.steps must be a whole number, got '3'"),
    "value out of range": ("steps = 3", "steps = 0", "at least 1, got 0"),
    "wrong value in a row": ('kind = "static"', 'kind = "statik"', "did you mean static?"),
    "wrong value of a scene": ("data.size = 12", "data.size = -1", "others, static: data.size must lie between"),
    "unknown method": ('method = "grid4d"', 'method = "grid5d"', "rows.grid4d.method must be static or"),
    "unknown part": ('method = "grid4d"', 'ablate = ["lapp"]', "rows.grid4d.ablate knows"),
    "parts that are no list": ('method = "grid4d"', 'ablate = "lap"', "ablate must be a list of parts, got 'lap'"),
    "unknown scene": ('scenes = ["toys"]', 'scenes = ["toy"]', "rows.grid4d.scenes: 'toy' is none of toys, others"),
    "no such seed": ("seeds = [5]", "seeds = [4]", "rows.grid4d.seeds: 4 is none of 3, 5"),
    "no rows": (SPEC[SPEC.index("[rows]") :], "", "rows must be a table with at least one entry"),
    "a row that is no table": ("grid4d = {", "x = 3\ngrid4d = {", "rows.x must be a table"),
    "a scene without a folder": ('folder = "toys"', "points.box = 1", "scenes.others must be a folder, or"),
    "a name that is no folder": ("grid4d = {", '"../up" = {', "'../up' must be a name of letters"),
    "a name that Windows cuts": ("grid4d = {", '"v1." = {', "'v1.' cannot be the name of a folder on Windows"),
    "a device of Windows": ("grid4d = {", '"aux.2" = {', "'aux.2' cannot be the name of a folder on Windows"),
    "names that share a folder": (
        "grid4d = {",
        "Static = {}\ngrid4d = {",
        "and another name differ in capital letters",
    ),
    "the seed in a row": ('kind = "static"', 'kind = "static", seed = 1', "must set neither seed nor data.path"),
    "the path in common": ("points.count", 'data.path = "x"\npoints.count', "must set neither seed nor data.path"),
    "missing folder": ('\ntoys = "toys"', '\ntoys = "toyz"', "toyz does not exist"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_end_in_one_sentence_before_any_training(
    name: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after, message = MISTAKES[name]
    assert SPEC.count(before) == 1
    (tmp_path / "spec.toml").write_text(SPEC.replace(before, after))
    arguments = [str(tmp_path / "spec.toml"), "--data", str(data), "--out", str(tmp_path / "out")]
    assert table_cli.table_command(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("lapgs-table: ")
    assert message in err
    assert not (tmp_path / "out").exists()


COMMAND_MISTAKES = {
    "nothing": ([], "name a SPEC.toml"),
    "no out": (["SPEC"], "--out"),
    "missing spec": (["nowhere.toml", "--out", "OUT"], "nowhere.toml does not exist"),
    "missing results": (["--from", "nowhere.json"], "nowhere.json does not exist"),
    "results of something else": (["--from", "SPEC"], "cannot be read as JSON"),
    "unknown option": (["SPEC", "--outt", "x"], "lapgs-table --help lists the options"),
    "out is a file": (["SPEC", "--out", "SPEC"], "is a file"),
    "unknown device": (["SPEC", "--data", "DATA", "--out", "OUT", "--device", "GTX 9999"], "'GTX 9999'"),
}


@pytest.mark.parametrize("name", COMMAND_MISTAKES)
def test_mistakes_on_the_command_line(
    name: str, data: Path, spec_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, message = COMMAND_MISTAKES[name]
    places = {"SPEC": str(spec_file), "OUT": str(tmp_path / "out"), "DATA": str(data)}
    assert table_cli.table_command([places.get(word, word) for word in words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1, err
    assert message in err
    assert not (tmp_path / "out").exists()


# The table


def test_a_line_has_means_and_the_sample_standard_deviation() -> None:
    runs = (
        result(seed=0, psnr=20.0, seconds=10.0, gaussians=1000),
        result(seed=1, psnr=23.0, seconds=30.0, gaussians=2001, ssim=0.7),
        result(row="y"),
    )
    lines = markdown(Results("name", "tiny", runs)).splitlines()
    assert lines[0] == "## name"
    assert lines[2] == "| scene | model | seeds | PSNR | ± | SSIM | Gaussians | steps/s | training, s |"
    assert lines[4] == "| a | x | 2 | 21.50 | 2.12 | 0.6000 | 1,500 | 20.0 | 20 |"
    assert lines[5] == "| a | y | 1 | 20.00 | - | 0.5000 | 1,000 | 30.0 | 10 |"
    assert not any("scenes |" in line for line in lines), "one scene needs no mean over scenes"


def test_the_mean_over_scenes_weighs_scenes_alike_and_counts_them() -> None:
    runs = (
        result("a", seed=0, psnr=20.0), result("a", seed=1, psnr=22.0), result("a", seed=2, psnr=24.0),
        result("b", seed=0, psnr=30.0), result("b", seed=1, psnr=34.0), result("b", "y", psnr=10.0),
    )  # fmt: skip
    lines = markdown(Results("name", "tiny", runs)).splitlines()
    # Scenes: 22 and 32. Seeds that both have: 25 and 28.
    assert "| x | 2 of 2 | 27.00 | 2.12 | 0.5000 | 1,000 | 30.0 | 10 |" in lines
    assert "| y | 1 of 2 | 10.00 | - | 0.5000 | 1,000 | 30.0 | 10 |" in lines


def test_results_say_with_what_they_were_made() -> None:
    runs = (result(), result(seed=1), result(seed=2, environment={"torch": "3"}, size=(12, 12)))
    text = markdown(Results("name", "tiny", runs))
    assert "torch 2 (2 runs); torch 3 (1 run)." in text
    assert "2 test views of 24x24 (2 runs); 2 test views of 12x12 (1 run)." in text
    assert "\n2 validation views of 24x24." in markdown(Results("name", "tiny", (result(split="val"),)))


CURVE = ((10.0, 24.0), (20.0, 34.0), (30.0, 33.5))


def test_when_a_curve_reaches_a_quality() -> None:
    assert seconds_to(CURVE, 20.0) == 10.0, "before its first measurement nothing is known"
    assert seconds_to(CURVE, 30.0) == pytest.approx(16.0)
    assert seconds_to(CURVE, 34.0) == 20.0
    assert seconds_to(CURVE, 36.0) is None
    assert seconds_to((), 30.0) is None


def test_the_table_says_how_long_each_quality_took() -> None:
    runs = (result(curve=CURVE), result(seed=1, curve=((10.0, 30.0), (20.0, 32.0))), result(row="y"))
    lines = markdown(Results("name", "tiny", runs)).splitlines()
    at = lines.index("| scene | model | 30 dB | 33 dB | 36 dB | best |")
    assert lines[at + 2] == "| a | x | 13 | - | - | 33.00 dB |"
    assert not lines[at + 3].startswith("|"), "a run without a curve has no line"
    assert "33 dB" not in markdown(Results("name", "tiny", (result(),)))


def test_results_survive_the_file(tmp_path: Path) -> None:
    results = Results("name", "tiny", (result(curve=CURVE), result("b", seconds=3)))
    write_results(tmp_path, results)
    assert read_results(tmp_path / "results.json") == results
    assert (tmp_path / "table.md").read_text() == markdown(results)


@pytest.mark.parametrize("change", [{"format": "else"}, {"runs": 3}, {"runs": [3]}, {"runs": [{"scene": "a"}]}])
def test_damaged_results_are_refused(change: dict, tmp_path: Path) -> None:
    write_results(tmp_path, Results("name", "tiny", (result(),)))
    content = json.loads((tmp_path / "results.json").read_text())
    (tmp_path / "results.json").write_text(json.dumps({**content, **change}))
    with pytest.raises(InputError, match=r"results.json"):
        read_results(tmp_path / "results.json")


def test_results_of_several_machines_are_merged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, results in {"a": (result(), result(seed=1)), "b": (result(seed=1), result(seed=2))}.items():
        (tmp_path / name).mkdir()
        write_results(tmp_path / name, Results(name, "tiny", results))
    files = [str(tmp_path / name / "results.json") for name in ("a", "b")]
    assert table_cli.table_command(["--from", *files, "--out", str(tmp_path / "both")]) == 0
    shown = capsys.readouterr().out
    assert "| a | x | 3 | 20.00 | 0.00 |" in shown
    assert (tmp_path / "both" / "table.md").read_text() == shown
    assert len(read_results(tmp_path / "both" / "results.json").runs) == 3
    assert table_cli.table_command(["--from", files[0], "--out", str(tmp_path / "both")]) == 2
    assert "results.json would be lost" in capsys.readouterr().err
    assert (
        table_cli.table_command(["--from", *files, str(tmp_path / "both" / "results.json"), "--out", str(tmp_path)])
        == 0
    )
    with pytest.raises(InputError, match=r"a, x, seed 0: .* two configurations"):
        merge_results([Results("a", "tiny", (result(),)), Results("b", "tiny", (result(fingerprint="g"),))])


# The runs


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[RunKey]:
    """Instead of training, leaves a run folder with made-up figures, and notes here which run it was."""
    done: list[RunKey] = []

    def train(run: Run, data: Path, out: Path, launch: table.Launch) -> None:
        done.append(run.key)
        (out / "eval").mkdir(parents=True, exist_ok=True)
        (out / "checkpoint.ply").write_text("large")
        line = {"step": 1, "val_psnr": 31.0, "val_views": "val", "timing": {"seconds": 2.5}}
        (out / "log.jsonl").write_text('{"step": 1, "psnr": 20.0}\n' + json.dumps(line) + "\n")
        record = {"torch": "2", "adapter": "none"}
        (out / "config.toml").write_text(write_toml({**dataclasses.asdict(run.config), "record": record}))
        training = {"steps": run.config.schedule.steps, "seconds": 6.0}
        metrics = {"psnr": 20.0 + run.key.seed, "ssim": 0.5, "gaussians": 50, "size": (24, 24), "views": [{}, {}]}
        (out / "metrics.json").write_text(json.dumps({**metrics, "training": training}))

    monkeypatch.setattr(table, "_run_in_process", train)
    return done


def make(spec_file: Path, data: Path, *more: str) -> int:
    return table_cli.table_command([str(spec_file), "--data", str(data), "--out", str(spec_file.parent / "out"), *more])


def test_finished_runs_are_not_trained_again(
    spec_file: Path, data: Path, trained: list[RunKey], capsys: pytest.CaptureFixture[str]
) -> None:
    out = spec_file.parent / "out"
    assert make(spec_file, data) == 0
    assert len(trained) == 5
    shown = capsys.readouterr()
    assert "run 1 of 5: toys, static, seed 3 (time left not known yet)" in shown.err
    assert "run 5 of 5: others, static, seed 5 (about 0:00:06 left)" in shown.err
    assert shown.out == f"{out / 'table.md'}: 5 of 5 runs\n"
    assert (out / "toys" / "static" / "seed3" / "checkpoint.ply").exists()
    tables = {name: (out / name).read_bytes() for name in ("table.md", "results.json")}
    assert read_results(out / "results.json").runs[0].curve == ((2.5, 31.0),)
    assert (out / "curves.png").exists() == plots.available()

    assert make(spec_file, data) == 0
    (out / "results.json").unlink()
    assert make(spec_file, data) == 0, "the run folders suffice"
    shutil.rmtree(out / "toys")
    shutil.rmtree(out / "others")
    assert make(spec_file, data.parent / "nowhere") == 0, "results.json suffices, without the pictures, too"
    assert len(trained) == 5
    assert tables == {name: (out / name).read_bytes() for name in ("table.md", "results.json")}

    (out / "results.json").rename(spec_file.parent / "committed.json")
    shutil.rmtree(out)
    assert make(spec_file, data, "--from", str(spec_file.parent / "committed.json")) == 0
    assert len(trained) == 5
    assert tables == {name: (out / name).read_bytes() for name in ("table.md", "results.json")}


def test_unfinished_and_changed_runs_are_trained_again(
    spec_file: Path, data: Path, trained: list[RunKey], capsys: pytest.CaptureFixture[str]
) -> None:
    out = spec_file.parent / "out"
    make(spec_file, data)
    (out / "results.json").unlink()
    (out / "toys" / "static" / "seed3" / "metrics.json").unlink()  # interrupted
    (out / "toys" / "static" / "seed5" / "metrics.json").write_text("{")
    interrupted = out / "others" / "static" / "seed3" / "metrics.json"  # and then measured by lapgs-train --eval
    interrupted.write_text(interrupted.read_text().replace('"steps": 3', '"steps": 2'))
    trained.clear()
    assert make(spec_file, data) == 0
    assert [tuple(key) for key in trained] == [("toys", "static", 3), ("toys", "static", 5), ("others", "static", 3)]

    trained.clear()
    capsys.readouterr()
    spec_file.write_text(SPEC.replace("grid4d = {", "grid4d = { field.width = 16,"))
    before = (out / "results.json").read_bytes()
    assert make(spec_file, data) == 0
    assert [tuple(key) for key in trained] == [("toys", "grid4d", 5)]
    assert (out / "results.before.json").read_bytes() == before
    assert "1 runs of" in capsys.readouterr().err
    spec_file.write_text(SPEC.replace("grid4d = {", "grid4d = { field.width = 12,"))
    assert make(spec_file, data) == 0
    assert (out / "results.before.json").read_bytes() == before
    assert "results.before-2.json keeps their results" in capsys.readouterr().err
    assert len(read_results(out / "results.before-2.json").runs) == 5


def test_measures_that_some_runs_lack_have_columns(tmp_path: Path) -> None:
    runs = (result(), result(seed=1, ms_ssim=0.91, lpips=0.123, lpips_unscaled=0.045), result("b", ms_ssim=0.5))
    shown = markdown(Results("t", "tiny", runs)).splitlines()
    assert "| PSNR | ± | SSIM | MS-SSIM | LPIPS | LPIPS [0, 1] | Gaussians |" in shown[2]
    assert "| 0.5000 | - | - | - | 1,000 |" in shown[4]
    assert "| 0.5000 | 0.5000 | - | - | 1,000 |" in shown[5]
    write_results(tmp_path, Results("t", "tiny", runs))
    assert read_results(tmp_path / "results.json").runs == runs
    assert "lpips" not in json.loads((tmp_path / "results.json").read_text())["runs"][0]


def test_weights_for_lpips_reach_every_run_and_are_checked_first(
    spec_file: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert make(spec_file, data, "--lpips-weights", str(tmp_path / "none.safetensors")) == 2
    assert "none.safetensors cannot be read" in capsys.readouterr().err
    commands: list[list[str]] = []

    def start(command: list[str], **_: object) -> None:
        commands.append(command)
        raise InputError("not today")

    monkeypatch.setattr("lapgs_wgpu.train.lpips.Lpips", lambda file: None)
    monkeypatch.setattr(table.subprocess, "Popen", start)
    assert make(spec_file, data, "--lpips-weights", str(tmp_path / "vgg.safetensors")) == 2
    assert f"--lpips-weights={tmp_path / 'vgg.safetensors'}" in commands[0]


def with_large_images(folder: Path) -> None:
    """The runs of the fixture `trained` are large enough for LPIPS."""
    for file in folder.rglob("metrics.json"):
        file.write_text(json.dumps({**json.loads(file.read_text()), "size": [64, 64]}))


def test_finished_runs_without_lpips_are_measured_again(
    spec_file: Path,
    data: Path,
    trained: list[RunKey],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = spec_file.parent / "out"
    assert make(spec_file, data) == 0
    with_large_images(out)
    (out / "results.json").unlink()
    (out / "toys" / "grid4d" / "seed5" / "checkpoint.ply").unlink()
    measured: list[RunKey] = []

    def measure(run: Run, data: Path, out: Path, launch: table.Launch) -> None:
        measured.append(run.key)
        metrics = json.loads((out / "metrics.json").read_text())
        (out / "metrics.json").write_text(json.dumps({**metrics, "lpips": 0.25}))

    monkeypatch.setattr("lapgs_wgpu.train.lpips.Lpips", lambda file: None)
    monkeypatch.setattr(table, "_run_in_process", measure)
    for _ in range(2):
        assert make(spec_file, data, "--lpips-weights", str(spec_file.parent / "vgg.safetensors")) == 0
        told = capsys.readouterr().err
        assert "1 finished runs, such as toys, grid4d, seed 5, have no LPIPS and no checkpoint" in told
        assert len(measured) == 4
    runs = read_results(out / "results.json").runs
    assert [run.lpips for run in runs] == [None if run.row == "grid4d" else 0.25 for run in runs]


def test_a_trained_run_is_measured_on_the_views_of_the_table(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """lapgs-train --eval on other views does not make figures of theirs a table's."""
    spec, out = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(SPEC.replace("seeds = [3, 5]", "seeds = [5]").replace('static = { field.kind = "static" }\n', ""))
    shutil.copytree(data, tmp_path / "data")
    shutil.copy(tmp_path / "data/toys/transforms_test.json", tmp_path / "data/toys/transforms_val.json")
    assert make(spec, tmp_path / "data") == 0
    before = (out / "table.md").read_bytes()
    assert "2 test views of 24x24" in before.decode()
    run = out / "toys" / "grid4d" / "seed5"
    assert cli.train_command(["--eval", str(run), "--data.split", "val"]) == 0
    assert "2 validation views of 24x24" in capsys.readouterr().out
    assert json.loads((run / "metrics.json").read_text())["split"] == "val"
    checkpoint = (run / "checkpoint.ply").stat()
    (out / "results.json").unlink()
    assert make(spec, tmp_path / "data") == 0
    assert (run / "checkpoint.ply").stat() == checkpoint, "it is measured, not trained"
    assert (out / "table.md").read_bytes() == before


def test_views_to_watch_are_checked_before_any_training(
    spec_file: Path, data: Path, trained: list[RunKey], capsys: pytest.CaptureFixture[str]
) -> None:
    watched = 'grid4d = { eval.interval = 1, eval.views = "r_9", '
    spec_file.write_text(SPEC.replace("grid4d = { ", watched))
    assert make(spec_file, data) == 2
    assert "eval.views names 'r_9'" in capsys.readouterr().err
    assert not trained


def test_curves_go_with_the_table_that_had_them(spec_file: Path, data: Path, trained: list[RunKey]) -> None:
    out = spec_file.parent / "out"
    out.mkdir()
    (out / "curves.png").write_bytes(b"of another table")
    assert make(spec_file, data, "--hours", "0.001") == command.TIME_OVER
    assert not (out / "curves.png").exists()


def test_a_table_stops_in_time(
    spec_file: Path, data: Path, trained: list[RunKey], capsys: pytest.CaptureFixture[str]
) -> None:
    assert make(spec_file, data, "--hours", "0.001") == command.TIME_OVER
    assert not trained
    assert capsys.readouterr().out.endswith("0 of 5 runs; the time is over, and the same command goes on\n")
    assert make(spec_file, data, "--hours", "1") == 0
    assert len(trained) == 5
    assert make(spec_file, data, "--hours", "0") == 2


def test_a_run_that_is_stopped_in_time_goes_on(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends with the bytes of one that was never stopped, from a folder that was moved meanwhile."""
    spec, log = tmp_path / "spec.toml", Path("toys", "grid4d", "seed5", "log.jsonl")
    spec.write_text(SPEC.replace("schedule.steps = 3", "schedule.steps = 150").replace("seeds = [3, 5]", "seeds = [5]"))
    spec.write_text(spec.read_text().replace('static = { field.kind = "static" }\n', ""))
    assert make(spec, data) == 0
    (tmp_path / "out").rename(tmp_path / "whole")

    class Soon(threading.Timer):
        """Is over as soon as the training has begun."""

        def run(self) -> None:
            while not ((tmp_path / "out" / log).exists() and (tmp_path / "out" / log).stat().st_size):
                time.sleep(0.01)
            monkeypatch.setattr(table.Launch, "seconds_left", -1.0)
            self.function(*self.args)

    capsys.readouterr()
    with monkeypatch.context() as patched:
        patched.setattr(table.threading, "Timer", Soon)
        assert make(spec, data, "--hours", "1") == command.TIME_OVER
    monkeypatch.undo()
    assert "0 of 1 runs; the time is over" in capsys.readouterr().out
    steps = [json.loads(line)["step"] for line in (tmp_path / "out" / log).read_text().splitlines()]
    assert 50 <= steps[-1] < 150
    elsewhere = data.parent / "moved"
    shutil.copytree(data, elsewhere)
    assert make(spec, elsewhere) == 0
    assert capsys.readouterr().out.endswith("1 of 1 runs\n")
    after = [json.loads(line)["step"] for line in (tmp_path / "out" / log).read_text().splitlines()]
    assert after[: len(steps)] == steps
    first, second = ((tmp_path / name / log).with_name("checkpoint.ply") for name in ("whole", "out"))
    assert first.read_bytes() == second.read_bytes()


def test_the_table_is_written_after_every_run(
    spec_file: Path,
    data: Path,
    trained: list[RunKey],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    original, seen = table._run_in_process, []

    def look(run: Run, data: Path, out: Path, launch: table.Launch) -> str | None:
        seen.append(len(read_results(spec_file.parent / "out" / "results.json").runs))
        if len(seen) == 4:
            raise KeyboardInterrupt
        return original(run, data, out, launch)

    monkeypatch.setattr(table, "_run_in_process", look)
    assert make(spec_file, data) == command.INTERRUPTED
    assert capsys.readouterr().err.endswith("lapgs-table: stopped in run 4 of 5; the same command goes on.\n")
    assert seen == [0, 1, 2, 3]
    assert "| toys | grid4d | 1 | 25.00 | - |" in (spec_file.parent / "out" / "table.md").read_text()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_ends_a_table_as_ctrl_c_does(
    name: str, spec_file: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    number = getattr(signal, name)

    def ended(run: Run, data: Path, out: Path, launch: table.Launch) -> str | None:
        signal.raise_signal(number)
        return "went on"

    monkeypatch.setattr(table, "_run_in_process", ended)
    with handled(number, signal.SIG_DFL):  # which the tests themselves may not have, begun by nohup
        assert make(spec_file, data) == command.INTERRUPTED
        assert signal.getsignal(number) == signal.SIG_DFL
    assert capsys.readouterr().err.endswith("lapgs-table: stopped in run 1 of 5; the same command goes on.\n")


def test_a_signal_that_is_ignored_ends_no_table(
    spec_file: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As nohup does with SIGHUP."""

    def ignored(run: Run, data: Path, out: Path, launch: table.Launch) -> str | None:
        signal.raise_signal(signal.SIGHUP)
        return "went on"

    monkeypatch.setattr(table, "_run_in_process", ignored)
    with handled(signal.SIGHUP, signal.SIG_IGN):
        assert make(spec_file, data) == 1
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    assert capsys.readouterr().err.count("failed: went on") == 2 * 5, "each run, and again at the end"


def test_two_tables_do_not_write_to_one_folder(
    spec_file: Path, data: Path, trained: list[RunKey], capsys: pytest.CaptureFixture[str]
) -> None:
    with locked_folder(spec_file.parent / "out", "lapgs-table"):
        assert make(spec_file, data) == 2
    assert "out is being written by another lapgs-table (process" in capsys.readouterr().err
    assert not trained


def test_a_slim_table_keeps_the_figures_of_its_runs(spec_file: Path, data: Path, trained: list[RunKey]) -> None:
    make(spec_file, data, "--slim")
    out = spec_file.parent / "out"
    kept = {file.name for file in (out / "toys" / "static" / "seed3").iterdir()}
    assert kept == {"config.toml", "log.jsonl", "metrics.json"}
    (out / "results.json").unlink()
    make(spec_file, data)
    assert len(trained) == 5


def test_runs_are_trained_in_processes_and_a_failed_one_stops_no_other(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The real thing: two short trainings, of which the first finds a file where its folder should be."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "first").write_text("")
    text = SPEC[: SPEC.index("[scenes]")].replace("[3, 5]", "[3]")
    (tmp_path / "spec.toml").write_text(
        f'{text}[scenes]\nfirst = "toys"\nsecond = "toys"\n[rows]\nstatic = {{ field.kind = "static" }}\n'
    )
    assert make(tmp_path / "spec.toml", data) == 1
    shown = capsys.readouterr()
    assert shown.out == f"{tmp_path / 'out' / 'table.md'}: 1 of 2 runs\n"
    assert "lapgs-table: first, static, seed 3 failed: " in shown.err
    assert str(tmp_path / "out" / "first") in shown.err.splitlines()[-1]
    run = tmp_path / "out" / "second" / "static" / "seed3"
    metrics = json.loads((run / "metrics.json").read_text())
    (only,) = read_results(tmp_path / "out" / "results.json").runs
    assert (only.psnr, only.steps, only.views) == (metrics["psnr"], 3, 2)
    assert only.environment["adapter"] == metrics["environment"]["adapter"]
    assert load_config(str(run / "config.toml")).data.path == str(data / "toys")


def test_motion_scenes_are_written_beside_the_runs(
    tmp_path: Path, trained: list[RunKey], monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []

    def write(folder: Path, scene: MotionScene) -> Path:
        written.append((folder.name, scene))
        return folder

    monkeypatch.setattr(motion_writer, "write_motion", write)
    name = "motion:path=4,camera=walk"
    (tmp_path / "spec.toml").write_text(
        SPEC.replace('"toys"\n', f'"{name}"\n').replace('folder = "toys"', f'folder = "{name}"')
    )
    assert make(tmp_path / "spec.toml", tmp_path / "nowhere") == 0
    assert len(trained) == 5
    assert written == [("motion-path4-cycles2-walk-black-two", MotionScene(path=4, camera="walk"))]


def test_figures_of_motion_have_columns_where_any_run_has_them(tmp_path: Path) -> None:
    plain = Results("t", "tiny", (result(),))
    assert "moving PSNR" not in markdown(plain)
    measured = result("b", psnr_moving=21.25, found=0.875, track_error=0.125)
    lost = result("b", seed=1, psnr_moving=12.75, found=0.125)  # whose object is not found
    both = Results("t", "tiny", (result(), measured, lost))
    text = markdown(both)
    assert "| seconds" not in text
    assert "| training, s | moving PSNR | found | track |" in text
    assert "| 10 | - | - | - |" in text
    assert "| 10 | 17.00 | 50% | - |" in text
    assert "| 10 | 21.25 | 88% | 0.12 |" in markdown(Results("t", "tiny", (measured,)))
    write_results(tmp_path, both)
    assert read_results(tmp_path / "results.json") == both
    stored = json.loads((tmp_path / "results.json").read_text())["runs"]
    assert ["found" in run for run in stored] == [False, True, True]


@pytest.mark.parametrize("value", ["high", True, 1e20])
def test_damaged_figures_of_motion_are_refused(value: object, tmp_path: Path) -> None:
    write_results(tmp_path, Results("t", "tiny", (result(found=0.5),)))
    file = tmp_path / "results.json"
    file.write_text(file.read_text().replace('"found": 0.5', f'"found": {json.dumps(value)}'))
    with pytest.raises(InputError, match="run 1: found must"):
        read_results(file)


def test_the_built_in_scene_is_written_once(
    tmp_path: Path, trained: list[RunKey], monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []

    def write(folder: Path) -> Path:
        written.append(folder)
        return folder

    monkeypatch.setattr(synthetic, "write_synthetic", write)
    (tmp_path / "spec.toml").write_text(
        SPEC.replace('"toys"\n', '"synthetic"\n').replace('folder = "toys"', 'folder = "synthetic"')
    )
    assert make(tmp_path / "spec.toml", tmp_path / "nowhere") == 0
    assert len(trained) == 5
    assert written == [tmp_path / "out" / ".data" / "synthetic"]


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("echo 'step 1' >&2; kill -KILL $$", "ended by SIGKILL"),
        ("echo 'Traceback' >&2; echo 'RuntimeError: no memory' >&2; exit 1", "RuntimeError: no memory"),
        ("exit 7", "exit code 7"),
        ("exit 0", "holds no finished run"),
    ],
)
def test_why_a_run_failed_is_told(
    script: str,
    reason: str,
    data: Path,
    spec_file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    python = spec_file.parent / "python"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(0o755)
    monkeypatch.setattr(table.sys, "executable", str(python))
    assert make(spec_file, data) == 1
    shown = capsys.readouterr()
    assert "0 of 5 runs" in shown.out
    last = shown.err.splitlines()[-1]
    assert last.startswith("lapgs-table: others, static, seed 5 failed: ")
    assert last.endswith(reason)
    assert "No run is finished yet." in (spec_file.parent / "out" / "table.md").read_text()


@pytest.mark.parametrize("name", ["method"])
def test_measured_runs_keep_their_fingerprints(name: str) -> None:
    """Keys that are added to the configuration leave results as they are where their value is that of before."""
    folder = Path(__file__).parents[1] / "docs" / "tables"
    planned = {(run.key, run.fingerprint) for run in read_spec(folder / f"{name}.toml").runs}
    measured = read_results(folder / f"{name}.results.json").runs
    assert {(run.key, run.fingerprint) for run in measured} == planned
