"""Interrupted and killed trainings go on to the same bytes; what was saved survives; two writers are kept apart."""

import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.interrupts import handled, interrupt_at
from helpers.training import STEPS, configure
from synthetic import write_synthetic

from lapgs_wgpu import cli
from lapgs_wgpu import run as run_module
from lapgs_wgpu.data import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io import atomic
from lapgs_wgpu.io.folder_lock import locked_folder
from lapgs_wgpu.io.safe_json_toml import read_toml
from lapgs_wgpu.run import resume, train
from lapgs_wgpu.train import run_folder
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.host import step_threads
from lapgs_wgpu.train.presets import write_toml
from lapgs_wgpu.train.run_folder import STATE, load_state, save_state
from lapgs_wgpu.train.trainer import Trainer

KILLS = int(os.environ.get("LAPGS_SOAK_KILLS", "3"))


# In the warm-up, after it, at a change of density, at the last step but one.
@pytest.mark.parametrize("at", [4, 20, *(pytest.param(at, marks=pytest.mark.nightly) for at in (11, STEPS - 1))])
def test_an_interrupted_run_goes_on_to_the_same_bytes(
    at: int, trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        interrupt_at(at, patched, {11: signal.SIGTERM, 20: signal.SIGHUP}.get(at, signal.SIGINT))
        with (
            handled(signal.SIGHUP, signal.SIG_DFL),
            pytest.raises(KeyboardInterrupt, match=f"after step {at} of {STEPS}"),
        ):
            train(configure(), dataset, tmp_path / "run", device=device)
    assert not (tmp_path / "run" / "metrics.json").exists()
    resume(configure(), dataset, tmp_path / "run", device=device)
    assert (tmp_path / "run" / "checkpoint.ply").read_bytes() == (trained_run / "checkpoint.ply").read_bytes()
    assert {file.name for file in (tmp_path / "run").iterdir()} == {file.name for file in trained_run.iterdir()}


KINDS = [
    *(pytest.param({"method": each}, marks=pytest.mark.nightly, id=each) for each in ("static", "mlp", "hexplane")),
    pytest.param({"method": "grid4d"}, marks=pytest.mark.nightly, id="grid4d"),
    pytest.param({"cameras__refine": "on", "cameras__start": "5", "exposure__enabled": "true"}, id="corrections"),
    pytest.param({"timing__refine": "true", "timing__start": "15", "timing__interval": "6"}, id="times"),
    pytest.param({"schedule__half_size_steps": "23"}, id="half size"),
]


@pytest.mark.parametrize("given", KINDS)
def test_every_kind_of_training_goes_on_to_the_same_bytes(
    given: dict[str, str], dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(configure(**given), dataset, tmp_path / "whole", device=device)
    with monkeypatch.context() as patched:
        interrupt_at(23, patched)
        with pytest.raises(KeyboardInterrupt):
            train(configure(**given), dataset, tmp_path / "run", device=device)
    resume(configure(**given), dataset, tmp_path / "run", device=device)
    assert (tmp_path / "run" / "checkpoint.ply").read_bytes() == (tmp_path / "whole" / "checkpoint.ply").read_bytes()


def test_states_are_saved_at_intervals(
    dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[int] = []
    original = run_folder.save_state

    def note(out: Path, state: run_folder.State) -> None:
        original(out, state)
        saved.append(int(state["training.done"]))

    monkeypatch.setattr("lapgs_wgpu.train.run_folder.save_state", note)
    interrupt_at(28, monkeypatch)
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(configure(schedule__save_interval="10"), dataset, out, device=device)
    assert saved == [10, 20, 28]
    assert int(load_state(out)["training.done"]) == 28  # type: ignore[index]


def test_a_damaged_state_is_told(tmp_path: Path) -> None:
    save_state(tmp_path, {"training.done": np.array(1)})
    content = (tmp_path / STATE).read_bytes()
    (tmp_path / STATE).write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=STATE):
        load_state(tmp_path)
    (tmp_path / STATE).unlink()
    assert load_state(tmp_path) is None


@pytest.mark.parametrize("failing", ["write", "replace"])
def test_a_full_disk_leaves_the_older_state(failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_state(tmp_path, {"training.done": np.array(1)})
    full = OSError(28, "No space left on device")

    def fail(*_: Any) -> None:
        raise full

    if failing == "write":
        monkeypatch.setattr(atomic.os, "fsync", fail)
    else:
        monkeypatch.setattr(atomic.os, "replace", fail)
    with pytest.raises(InputError, match=r"state.safetensors: not written \(No space left on device\)"):
        save_state(tmp_path, {"training.done": np.array(2)})
    monkeypatch.undo()
    assert int(load_state(tmp_path)["training.done"]) == 1  # type: ignore[index]


def test_a_state_of_another_configuration_is_refused(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    save_state(tmp_path, Trainer(configure(), dataset, device).state())
    others = [configure(field__width="8"), configure(field__dynamics="4"), configure("mlp")]
    for config in others:
        with pytest.raises(InputError, match=r"its state and its config.toml do not belong together"):
            resume(config, dataset, tmp_path, device=device)


def test_a_finished_run_is_not_resumed(
    trained_run: Path, dataset: Dataset, device: Device, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="is finished: there is nothing to resume"):
        resume(configure(), dataset, trained_run, device=device)
    assert cli.train_command(["--resume", str(trained_run), "--steps", "3"]) == 2
    assert "so --schedule.steps cannot be given" in capsys.readouterr().err
    assert cli.train_command(["--resume", str(trained_run.parent / "nowhere")]) == 2
    assert "config.toml does not exist; --resume and --eval need the folder of a run" in capsys.readouterr().err


def test_a_run_that_was_stopped_while_it_was_measured_goes_on(
    trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(run_module, "evaluate", stopped)
        with pytest.raises(KeyboardInterrupt, match="while the test views were measured; lapgs-train --resume"):
            train(configure(), dataset, tmp_path / "run", device=device)
    resume(configure(), dataset, tmp_path / "run", device=device)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["training"]["steps"] == STEPS
    assert (tmp_path / "run" / "checkpoint.ply").read_bytes() == (trained_run / "checkpoint.ply").read_bytes()


def test_two_writers_are_kept_apart(tmp_path: Path) -> None:
    with locked_folder(tmp_path / "run"):
        program = (
            "import sys; from pathlib import Path\n"
            "from lapgs_wgpu.io.folder_lock import locked_folder\n"
            "from lapgs_wgpu.errors import InputError\n"
            "try:\n    with locked_folder(Path(sys.argv[1])): print('both')\n"
            "except InputError as error: print(error)"
        )
        command = [sys.executable, "-c", program, str(tmp_path / "run")]
        told = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
        assert told.startswith(f"{tmp_path / 'run'} is being written by another lapgs-train")
    assert not (tmp_path / "run").exists()  # it was empty
    with locked_folder(tmp_path / "run"):
        pass


def test_overwrite_replaces_nothing_but_runs(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    (tmp_path / "eval").mkdir()
    (tmp_path / "eval" / "thesis.txt").write_text("mine")
    (tmp_path / "config.toml").write_text("mine = true")
    with pytest.raises(InputError, match="holds files, but no run that --overwrite could replace"):
        train(configure(), dataset, tmp_path, device=device, overwrite=True)
    assert (tmp_path / "eval" / "thesis.txt").read_text() == "mine"


def test_a_run_goes_on_with_its_own_capture_only(
    dataset: Dataset,
    data: Path,
    device: Device,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    run, moved = tmp_path / "run", tmp_path / "moved"
    with monkeypatch.context() as patched:
        interrupt_at(4, patched)
        with pytest.raises(KeyboardInterrupt):
            train(configure(data__path=str(tmp_path / "gone"), schedule__steps="6"), dataset, run, device=device)
    before = {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()}
    assert cli.train_command(["--resume", str(run)]) == 2
    assert f"gone, the capture of {run / 'config.toml'}, does not exist; give --data" in capfd.readouterr().err
    other = write_synthetic(tmp_path / "other", size=24, train_views=8, test_views=2)
    for option in ("--resume", "--eval"):
        assert cli.train_command([option, str(run), "--data", str(other)]) == 2
        assert f"{other} is another capture than that of {run / 'config.toml'}" in capfd.readouterr().err
    assert before == {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()}
    shutil.copytree(data, moved)
    with monkeypatch.context() as patched:
        interrupt_at(5, patched)
        assert cli.train_command(["--resume", str(run), "--data", str(moved)]) == 130
    capfd.readouterr()
    assert cli.train_command(["--eval", str(run)]) == 0
    assert f"note: {run} was interrupted; its checkpoint is of step 5 of 6.\n" in capfd.readouterr().err
    assert cli.train_command(["--resume", str(run)]) == 0  # config.toml names the new folder
    assert read_toml(run / "config.toml")["data"]["path"] == str(moved)
    assert read_toml(run / "config.toml")["record"]["data"] == dataset.fingerprint


def test_a_run_without_its_state_is_not_begun_again(
    dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        interrupt_at(4, patched)
        with pytest.raises(KeyboardInterrupt):
            train(configure(), dataset, tmp_path, device=device)
    (tmp_path / STATE).unlink()
    before = (tmp_path / "checkpoint.ply").read_bytes()
    with pytest.raises(InputError, match=r"a checkpoint, but no state to go on from \(state.safetensors\)"):
        resume(configure(), dataset, tmp_path, device=device)
    assert (tmp_path / "checkpoint.ply").read_bytes() == before


def test_what_has_changed_since_the_run_began_is_told(
    dataset: Dataset, data: Path, device: Device, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = configure(data__path=str(data), schedule__steps="3", schedule__save_interval="0")
    run_folder.start_run_folder(tmp_path, config, device, dataset)
    text = (tmp_path / "config.toml").read_text()
    threads = step_threads(config.field, device) or torch.get_num_threads()
    text = text.replace(f'torch_threads = "{threads}"', 'torch_threads = "99"')
    (tmp_path / "config.toml").write_text(text.replace(f'driver = "{device.info.driver}"', 'driver = "another"'))
    assert cli.train_command(["--resume", str(tmp_path)]) == 0
    error = capfd.readouterr().err
    assert f"driver was another when {tmp_path} began and is {device.info.driver}: bits may differ." in error
    assert f"torch_threads was 99 when {tmp_path} began and is {threads}: bits may differ." in error
    assert error.count("bits may differ") == 2


@pytest.fixture
def command(data: Path, tmp_path: Path) -> list[str]:
    """lapgs-train on a configuration that saves often."""
    config: Config = configure(data__path=str(data), schedule__save_interval="3")
    (tmp_path / "small.toml").write_text(write_toml(dataclasses.asdict(config)))
    return [sys.executable, "-m", "lapgs_wgpu.cli", str(tmp_path / "small.toml")]


def finished(program: list[str]) -> None:
    subprocess.run(program, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=300)


def moments(seed: int, longest: float) -> Iterator[float]:
    draw = random.Random(seed)
    while True:
        yield draw.uniform(0.0, longest)


@pytest.mark.nightly
def test_killed_at_random_moments_and_resumed(command: list[str], tmp_path: Path) -> None:
    """With SIGKILL, anywhere: at the start, between and during the writing of states, while it evaluates."""
    start = time.monotonic()
    finished([*command, "--out", str(tmp_path / "whole")])
    longest = time.monotonic() - start
    expected = (tmp_path / "whole" / "checkpoint.ply").read_bytes()
    out = tmp_path / "run"
    going_on = [sys.executable, "-m", "lapgs_wgpu.cli", "--resume", str(out)]
    killed = 0
    for moment in moments(KILLS, longest):
        program = going_on if (out / "config.toml").exists() else [*command, "--out", str(out), "--overwrite"]
        process = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            code = process.wait(moment)
            assert code == 0
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            killed += 1
        if (out / "metrics.json").exists():  # whole: the next round begins anew
            assert (out / "checkpoint.ply").read_bytes() == expected
            shutil.rmtree(out)
        if killed == KILLS:
            break
    if not (out / "config.toml").exists():
        going_on = [*command, "--out", str(out), "--overwrite"]
    finished(going_on)
    assert (out / "checkpoint.ply").read_bytes() == expected
    assert not [file for file in out.iterdir() if file.suffix == ".tmp" or "state" in file.name]
