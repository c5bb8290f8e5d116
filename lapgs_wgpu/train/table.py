"""Trains the runs of a table that are not finished yet, each in a process of its own, and keeps the table up to date.

A process a run: the device's memory is all free again for the next one, and a run that crashes takes none with it.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.builtin import is_builtin, write_builtin
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import open_device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.safe_json_toml import read_json
from lapgs_wgpu.progress import in_place
from lapgs_wgpu.stop_signals import on_stop_signals
from lapgs_wgpu.train import plots
from lapgs_wgpu.train.lpips import SMALLEST
from lapgs_wgpu.train.monitor import monitored_views
from lapgs_wgpu.train.presets import load_config, write_toml
from lapgs_wgpu.train.run_folder import has_state, locked_folder
from lapgs_wgpu.train.table_results import Result, Results, read_results, read_run, write_results
from lapgs_wgpu.train.table_spec import Run, RunKey, Spec, fingerprint

# Of a run: Ctrl-C is for the table's process, which then asks the run's, once, to save its state.
_OWN_GROUP: dict[str, Any] = {"process_group": 0}
if sys.platform == "win32":
    _OWN_GROUP = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
SAVING = 30.0  # seconds that a run has to save its state when it is stopped


class Outcome(NamedTuple):
    """finished: how many runs. failed: those that did, each with the reason. stopped: whether the time was over."""

    finished: int
    failed: dict[RunKey, str]
    stopped: bool


class Launch(NamedTuple):
    """How runs are started. lpips: weights for it. until: of time.monotonic, when the one under way is stopped."""

    device: str | None = None
    lpips: Path | None = None
    until: float | None = None

    @property
    def seconds_left(self) -> float:
        return math.inf if self.until is None else self.until - time.monotonic()


def make_table(
    spec: Spec,
    data: Path,
    out: Path,
    *,
    known: Sequence[Results] = (),
    device: str | None = None,
    slim: bool = False,
    lpips: Path | None = None,
    hours: float | None = None,
) -> Outcome:
    """Train what is not finished; results.json and table.md in `out`, and curves.png where runs have a curve, are
    written anew after every run.

    data: the folder in which the scenes lie. known: finished runs from elsewhere, beside those of out/results.json and
    of the run folders out/SCENE/ROW/seedN. slim: drop checkpoint and pictures of each run that is done. lpips: weights
    for it; finished runs that lack it are measured again. hours: after which the run under way is stopped, so that the
    next call goes on with it.
    An interrupted run goes on from its last saved state. Raises InputError before the first training starts.
    """
    launch = Launch(device, lpips, None if hours is None else time.monotonic() + 3600 * hours - SAVING)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; name a folder for the table with --out.")
    # Each ends the table as Ctrl-C does, so that the training under way saves its state.
    with locked_folder(out, "lapgs-table"), on_stop_signals(signal.default_int_handler):
        return _train_table(spec, data, out, known, launch, slim)


def _train_table(spec: Spec, data: Path, out: Path, known: Sequence[Results], launch: Launch, slim: bool) -> Outcome:
    stored = [read_results(out / "results.json")] if (out / "results.json").exists() else []
    finished = _finished(spec, out, [*stored, *known])
    again = _to_measure_again(spec, out, finished) if launch.lpips else []
    pending = again + [run for run in spec.runs if run.key not in finished]
    folders = _scene_folders(pending, data, out)
    if pending:
        open_device(launch.device)  # only to learn now, and not from every run, that it is not there

    _keep_others(out, stored, finished)
    _write(spec, out, finished)
    failed: dict[RunKey, str] = {}
    for run in pending:
        if launch.seconds_left <= 0:
            return Outcome(len(finished), failed, stopped=True)
        number = len(finished.keys() | failed.keys() | {run.key})
        what = "measured again" if run.key in finished else _time_left(spec.runs, finished, failed)
        print(f"run {number} of {len(spec.runs)}: {run.key} ({what})", file=sys.stderr)
        folder = run_folder(out, run.key)
        try:
            reason = _run_in_process(run, folders[run.folder], folder, launch)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"stopped in run {number} of {len(spec.runs)}; the same command goes on.") from None
        result = read_run(folder, run)
        if result is None and launch.seconds_left <= 0:
            return Outcome(len(finished), failed, stopped=True)
        if reason or result is None:
            failed[run.key] = reason or f"{folder} holds no finished run"
            print(f"run {number} failed: {failed[run.key]}", file=sys.stderr)
            continue
        finished[run.key] = result
        _write(spec, out, finished)
        if slim:
            (folder / "checkpoint.ply").unlink(missing_ok=True)
            shutil.rmtree(folder / "eval", ignore_errors=True)
    return Outcome(len(finished), failed, stopped=False)


def run_folder(out: Path, key: RunKey) -> Path:
    return out / key.scene / key.row / f"seed{key.seed}"


def _finished(spec: Spec, out: Path, known: Sequence[Results]) -> dict[RunKey, Result]:
    """The runs that need no training: listed somewhere, or lying in their folder, in the wanted configuration."""
    listed = {(run.key, run.fingerprint): run for part in reversed(known) for run in part.runs}
    finished = {}
    for run in spec.runs:
        result = listed.get((run.key, run.fingerprint)) or read_run(run_folder(out, run.key), run)
        if result is not None:
            finished[run.key] = result
    return finished


def _to_measure_again(spec: Spec, out: Path, finished: Mapping[RunKey, Result]) -> list[Run]:
    """The finished runs that lack LPIPS and still have a checkpoint. A line on stderr counts those without one."""
    lacking = [
        run
        for run in spec.runs
        if (done := finished.get(run.key)) is not None and done.lpips is None and min(done.size) >= SMALLEST
    ]
    again: list[Run] = []
    gone: list[Run] = []
    for run in lacking:
        (again if _is_trained(run, run_folder(out, run.key)) else gone).append(run)
    if gone:
        print(
            f"{len(gone)} finished runs, such as {gone[0].key}, have no LPIPS and no checkpoint in their folders in "
            f"{out} by which to measure it.",
            file=sys.stderr,
        )
    return again


def _scene_folders(pending: Sequence[Run], data: Path, out: Path) -> dict[str, Path]:
    """Where the scenes of these runs lie; each is opened once, so that its mistakes show before any training."""
    folders: dict[str, Path] = {}
    datasets: dict[str, Dataset] = {}
    for run in sorted(pending, key=lambda run: is_builtin(run.folder)):  # those that are written, last
        name = run.folder
        if name not in folders and is_builtin(name):
            folders[name] = write_builtin(name, out / ".data").resolve()  # names of scenes start with no dot
        elif name not in folders:
            folders[name] = (data / name).resolve()
            if not folders[name].exists():
                raise InputError(
                    f"the scene {run.key.scene} of the table: {folders[name]} does not exist; --data names the folder "
                    "of its scenes."
                )
            datasets[name] = load_dataset(folders[name])
        if run.config.eval.interval:
            datasets[name] = datasets.get(name) or load_dataset(folders[name])
            monitored_views(datasets[name], run.config.eval.views)
    return folders


def _keep_others(out: Path, stored: Sequence[Results], finished: Mapping[RunKey, Result]) -> None:
    """results.json is about to lose the runs that the table does not want any more; keep a copy of it then."""
    others = [run for part in stored for run in part.runs if finished.get(run.key) != run]
    if others:
        numbered = (f"results.before-{number}.json" for number in itertools.count(2))
        names = itertools.chain(["results.before.json"], numbered)
        kept = next(out / name for name in names if not (out / name).exists())
        with atomic_write(kept) as file:
            file.write((out / "results.json").read_bytes())
        print(
            f"{len(others)} runs of {out / 'results.json'} are not wanted any more, or in another configuration, "
            f"such as {others[0].key}; {kept.name} keeps their results, and new trainings replace their folders.",
            file=sys.stderr,
        )


def _write(spec: Spec, out: Path, finished: Mapping[RunKey, Result]) -> None:
    ordered = tuple(finished[run.key] for run in spec.runs if run.key in finished)
    write_results(out, Results(spec.name, spec.preset, ordered))
    curves = {str(run.key): run.curve for run in ordered if run.curve}
    if not curves:
        (out / "curves.png").unlink(missing_ok=True)  # of an earlier table
    elif plots.available():
        plots.quality_curves(out / "curves.png", curves)


def _time_left(runs: Sequence[Run], finished: Mapping[RunKey, Result], failed: Mapping[RunKey, str]) -> str:
    """An estimate from the time that a step took: in finished runs of the same row, else in all."""
    if not finished:
        return "time left not known yet"
    pace = {row: 1 / mean(r.steps_per_second for r in finished.values() if r.row == row) for _, row, _ in finished}
    overall = mean(pace.values())
    left = sum(
        run.config.schedule.steps * pace.get(run.key.row, overall)
        for run in runs
        if run.key not in finished and run.key not in failed
    )
    return f"about {timedelta(seconds=round(left))} left"


def _holds(run: Run, out: Path) -> bool:
    """Whether the folder holds this very run."""
    try:
        return fingerprint(load_config(str(out / "config.toml"))) == run.fingerprint
    except InputError:  # not there, or damaged
        return False


def _is_trained(run: Run, out: Path) -> bool:
    """Whether the folder holds this very run, trained to its end, with its checkpoint."""
    try:
        steps = read_json(out / "metrics.json")["training"]["steps"]
    except (InputError, KeyError, TypeError):
        return False
    return _holds(run, out) and steps == run.config.schedule.steps and (out / "checkpoint.ply").is_file()


def _run_in_process(run: Run, data: Path, out: Path, launch: Launch) -> str | None:
    """lapgs-train with this configuration, or lapgs-train --eval where it was trained already; what it tells goes to
    stderr. Returns why it failed, None if it did not."""
    with tempfile.TemporaryDirectory() as work:
        preset = Path(work) / "config.toml"
        preset.write_text(write_toml(dataclasses.asdict(run.config)), encoding="utf-8")
        command = [sys.executable, "-m", "lapgs_wgpu.cli", f"--data={data}"]
        if _is_trained(run, out):
            command += ["--eval", str(out.resolve()), f"--data.split={run.config.data.split}"]
        elif has_state(out) and _holds(run, out):
            command += ["--resume", str(out.resolve())]
        else:
            command += [str(preset), f"--out={out.resolve()}", "--overwrite"]
        command += [f"--device={launch.device}"] if launch.device else []
        command += [f"--lpips-weights={launch.lpips}"] if launch.lpips else []
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            **_OWN_GROUP,
        )
        timer = threading.Timer(min(launch.seconds_left, threading.TIMEOUT_MAX), partial(_ask_to_stop, process))
        timer.daemon = True
        timer.start()
        try:
            last = _pass_on(process)
            code = process.wait()
        except BaseException:
            _ask_to_stop(process)
            try:
                process.wait(SAVING)
            finally:
                process.kill()
                process.wait()
            raise
        finally:
            timer.cancel()
    if code < 0:
        return f"ended by {signal.Signals(-code).name}"
    return (last.removeprefix("lapgs-train: ") or f"exit code {code}") if code else None


def _ask_to_stop(process: subprocess.Popen[str]) -> None:
    """Ask a training to save its state and to end."""
    if sys.platform == "win32":  # whose `terminate` asks nothing
        process.send_signal(signal.CTRL_BREAK_EVENT)
    else:
        process.terminate()


def _pass_on(process: subprocess.Popen[str]) -> str:
    """Show the lines of a process, on a terminal all in one place; returns the last one."""
    assert process.stderr is not None
    on_terminal = sys.stderr.isatty()
    last = ""
    for line in process.stderr:
        last = line.strip() or last
        with suppress(OSError):  # the terminal may be gone
            sys.stderr.write(in_place(last) if on_terminal else f"  {last}\n")
            sys.stderr.flush()
    if on_terminal:
        with suppress(OSError):
            sys.stderr.write("\n")
    return last
