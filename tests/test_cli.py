"""lapgs-train: what it makes, and each of its users' mistakes in one sentence with the right exit code."""

import io
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import write_synthetic

from lapgs_wgpu import cli, command
from lapgs_wgpu.errors import NoAdapterError, quoted
from lapgs_wgpu.gpu import device as device_module

FAST = ["--steps", "3", "--points.count", "50", "--field", "static"]


def test_letters_that_the_terminal_lacks_end_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, encoding="cp1252"))
    assert command.guarded("lapgs-train", lambda arguments: print("runs/łódź"), []) == 0
    assert output.getvalue().strip() == rb"runs/\u0142\xf3d\u017a".replace(rb"\xf3", b"\xf3")


@pytest.mark.parametrize("platform", ["linux", "win32"])
def test_commands_can_be_pasted(platform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    path = "my films\\walk"
    assert quoted(path) == ('"my films\\walk"' if platform == "win32" else "'my films\\walk'")
    assert quoted("runs") == "runs"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("data") / "toys", size=24, train_views=3, test_views=2)


@pytest.fixture(scope="module")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert cli.train_command(["tiny", "--data", str(scene), "--out", str(out), *FAST]) == 0
    return out


def test_training_writes_a_run_and_prints_its_result(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.train_command(["tiny", "--data", str(scene), *FAST, "--data.size", "12"]) == 0
    out, err = capsys.readouterr()
    metrics = json.loads((tmp_path / "runs" / "toys-tiny" / "metrics.json").read_text())
    assert metrics["size"] == [12, 12]
    assert f"{metrics['psnr']:.2f} dB PSNR" in out
    assert "on 2 test views of 12x12, 50 Gaussians" in out
    assert err.count("\n") == 2  # the last state of the progress lines, of steps and test views
    assert err.endswith("2/2 test views measured  0:00 left\n")
    assert f'path = "{scene}"' in (tmp_path / "runs" / "toys-tiny" / "config.toml").read_text()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_no_run_is_replaced_where_no_window_opens(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("glfw")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "checkpoint.ply").write_text("of an earlier run")
    given = ["tiny", "--data", str(scene), *FAST, "--out", str(tmp_path), "--overwrite", "--view"]
    assert cli.train_command(given) == 2
    assert "there is no display): leave out --view" in capsys.readouterr().err
    assert [child.name for child in tmp_path.iterdir()] == ["checkpoint.ply"]


def test_a_runs_configuration_is_a_preset(run: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    assert cli.train_command([str(run / "config.toml"), "--out", str(again)]) == 0
    assert (again / "checkpoint.ply").read_bytes() == (run / "checkpoint.ply").read_bytes()


def test_evaluation_of_a_run_gives_the_same_figures(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = json.loads((run / "metrics.json").read_text())
    shutil.rmtree(run / "eval")
    (run / "metrics.json").unlink()
    assert cli.train_command(["--eval", str(run)]) == 0
    after = json.loads((run / "metrics.json").read_text())
    assert after["views"] == before["views"]
    assert after["training"] == {"steps": 3}
    assert sorted(file.name for file in (run / "eval").glob("*.png")) == ["test_000.png", "test_001.png"]
    assert "dB PSNR" in capsys.readouterr().out


def test_evaluation_keeps_the_record_of_the_training(run: Path, scene: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps({**metrics, "training": {"steps": 3, "seconds": 12.5}}))
    assert cli.train_command(["--eval", str(run), "--data", str(scene)]) == 0
    assert json.loads((run / "metrics.json").read_text())["training"]["seconds"] == 12.5


def test_evaluation_takes_what_changes_no_protocol(run: Path, scene: Path) -> None:
    before = json.loads((run / "metrics.json").read_text())
    given = ["--data", str(scene), "--data.background", "white", "--cache-gb", "0.1"]
    assert cli.train_command(["--eval", str(run), *given, "--device", before["environment"]["adapter"]]) == 0
    after = json.loads((run / "metrics.json").read_text())
    assert (before["background"], after["background"]) == ("black", "white")
    assert cli.train_command(["--eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["views"] == before["views"]


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["tiny"], "'tiny'"),
        (["--out", "OUT"], "--out"),
        (["--ablate", "ncc"], "--ablate"),
        (["--schedule.steps", "7"], "--schedule.steps"),
        (["--data", "nowhere", "--seed", "1", "--overwrite"], "--overwrite"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_evaluation_refuses_what_it_has_no_use_for(
    given: list[str], named: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (run / "metrics.json").read_bytes()
    assert cli.train_command(["--eval", str(run), *given]) == 2
    assert f"so {named} cannot be given" in capsys.readouterr().err
    assert (run / "metrics.json").read_bytes() == before


def test_the_built_in_scene_is_written_beside_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["tiny", "--data", "synthetic", "--out", str(tmp_path / "run"), *FAST, "--data.size", "16"]
    assert cli.train_command(command) == 0
    assert (tmp_path / "synthetic" / "transforms_train.json").exists()
    assert f'path = "{tmp_path / "synthetic"}"' in (tmp_path / "run" / "config.toml").read_text()
    assert cli.train_command(["--eval", str(tmp_path / "run")]) == 0


def test_list_devices(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.train_command(["--list-devices"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(device_module.list_devices())


MISTAKES = {
    "no preset": ([], "name a preset"),
    "no data": (["tiny", "--out", "OUT"], "--data DIR"),
    "unknown preset": (["tinny", "--data", "SCENE", "--out", "OUT"], "did you mean tiny?"),
    "unknown option": (["tiny", "--data", "SCENE", "--out", "OUT", "--stesp", "5"], "did you mean --steps?"),
    "one word too many": (["tiny", "SCENE", "--out", "OUT"], "is one word too many"),
    "not a number": (["tiny", "--data", "SCENE", "--out", "OUT", "--steps", "x"], "must be a whole number, got 'x'"),
    "unknown device": (["tiny", "--data", "SCENE", "--out", "OUT", "--device", "GTX 9999"], "'GTX 9999'"),
    "unprintable folder": (
        ["tiny", "--data", "a\udcff", "--out", "OUT"],
        "data.path holds 'a\\udcff', with characters that cannot be printed",
    ),
    "no scene": (["tiny", "--data", "USED", "--out", "OUT"], "is no scene in a known format"),
    "run folder in use": (["tiny", "--data", "SCENE", "--out", "USED"], "is not empty"),
    "run folder inside a file": (["tiny", "--data", "SCENE", "--out", "USED/file/run"], "file"),
    "no run": (["--eval", "nowhere"], "need the folder of a run"),
    "no checkpoint": (["--eval", "USED"], "does not exist"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_end_in_one_sentence(
    name: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    used = tmp_path / "used"
    used.mkdir()
    (used / "file").write_text("")
    places = {"SCENE": str(scene), "OUT": str(tmp_path / "out"), "USED": str(used), "USED/file": str(used / "file")}
    places["USED/file/run"] = str(used / "file" / "run")
    words, message = MISTAKES[name]
    assert cli.train_command([places.get(word, word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("lapgs-train: ")
    assert message in err
    assert [file.name for file in tmp_path.iterdir()] == ["used"]
    assert [file.name for file in used.iterdir()] == ["file"]


def test_a_damaged_scene_starts_no_run(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(scene, damaged)
    (damaged / "train" / "r_001.png").write_bytes(b"no picture")
    assert cli.train_command(["tiny", "--data", str(damaged), "--out", str(tmp_path / "out"), *FAST]) == 2
    assert "r_001.png is not a readable image" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_any_adapter_the_exit_code_is_3(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(name: str | None = None) -> None:
        raise NoAdapterError("no adapter was found on this machine")

    monkeypatch.setattr(device_module, "open_device", none)
    monkeypatch.setattr(command, "list_devices", list)
    assert cli.train_command(["tiny", "--data", str(scene), "--out", str(tmp_path / "out"), *FAST]) == 3
    assert capsys.readouterr().err == "lapgs-train: no adapter was found on this machine\n"
    assert not (tmp_path / "out").exists()


def test_ctrl_c_ends_with_130(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lapgs_wgpu import run as run_module

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt("stopped after step 1 of 2.")

    monkeypatch.setattr(run_module, "train", interrupted)
    assert cli.train_command(["tiny", "--data", str(scene), "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "lapgs-train: stopped after step 1 of 2.\n"


def test_a_pipe_that_is_closed_stops_no_training(scene: Path, tmp_path: Path) -> None:
    given = ["tiny", "--data", str(scene), "--out", str(tmp_path / "out"), *FAST]
    line = f"{shlex.join([sys.executable, '-m', 'lapgs_wgpu.cli', *given])} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], stderr=subprocess.PIPE, text=True, timeout=300)
    assert done.returncode == 0
    assert "pipe" not in done.stderr.lower()
    assert (tmp_path / "out" / "metrics.json").exists()


def test_the_installed_command() -> None:
    command = [sys.executable, "-c", "import sys; from lapgs_wgpu.cli import train_command; sys.exit(train_command())"]
    done = subprocess.run([*command, "tinny", "--data", "x"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "lapgs-train: there is no preset 'tinny'; did you mean tiny?\n"
