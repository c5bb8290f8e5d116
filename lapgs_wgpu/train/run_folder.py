"""The folder of a run: what lies in it, who may write to it, and the state from which a training goes on."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.tensors import pack_tensors, unpack_tensors
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.log import environment
from lapgs_wgpu.train.presets import write_toml

STATE, STATE_BEFORE, LOCK = "state.safetensors", "state.before.safetensors", ".lock"
RUN_FILES = ("config.toml", "log.jsonl", "metrics.json", "metrics.csv", "checkpoint.ply", "eval", STATE, STATE_BEFORE)

State = Mapping[str, NDArray[Any]]


def check_run_folder(out: Path, *, overwrite: bool) -> None:
    """InputError where a run cannot be written there."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; name a folder for the run with --out.")
    if overwrite or not out.exists():
        return
    if any(entry.name != LOCK for entry in out.iterdir()):
        raise InputError(f"{out} is not empty; name another folder with --out, or replace its run with --overwrite.")


@contextmanager
def locked_run_folder(out: Path) -> Iterator[None]:
    """The folder for one writer alone, made where it is missing. Raises InputError where another one has it."""
    out.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except ImportError:  # Windows: two writers are not kept apart there
        yield
        return
    lock = out / LOCK
    with open(lock, "a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not lock.exists() or not os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                raise BlockingIOError  # whoever had it has just removed it, and a third one may have another
        except OSError:
            file.seek(0)
            who = file.read(20).strip() or "unknown"
            raise InputError(
                f"{out} is being written by another lapgs-train (process {who}); wait for it, or name another folder."
            ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def start_run_folder(out: Path, config: Config, device: Device, dataset: Dataset) -> None:
    """Free the folder of an earlier run's files, and write config.toml."""
    for name in RUN_FILES:
        if (out / name).is_dir():
            shutil.rmtree(out / name)
        else:
            (out / name).unlink(missing_ok=True)
    table = {**dataclasses.asdict(config), "record": _record(device, dataset)}
    with atomic_write(out / "config.toml") as file:
        file.write(write_toml(table).encode())


def changes_since(out: Path, device: Device, dataset: Dataset) -> list[tuple[str, str, str]]:
    """What is not as it was when the run in this folder began, though its bits may depend on it: name, then, now."""
    try:
        record = tomllib.loads((out / "config.toml").read_text(encoding="utf-8")).get("record", {})
    except (OSError, ValueError):
        return []
    now = _record(device, dataset)
    return [(name, str(record[name]), now[name]) for name in now if record.get(name, now[name]) != now[name]]


def _record(device: Device, dataset: Dataset) -> dict[str, str]:
    return {**environment(device), "data": dataset.fingerprint}


def save_state(out: Path, state: State) -> None:
    """Write the state of a training; the one before it is kept under another name. Raises InputError where the disk
    does not allow it; what was there before is then unchanged."""
    with atomic_write(out / STATE) as file:
        for buffer in pack_tensors(state, {}):
            file.write(buffer)
        file.flush()
        if (out / STATE).exists():
            os.replace(out / STATE, out / STATE_BEFORE)


def load_state(out: Path) -> dict[str, NDArray[Any]] | None:
    """The last state that is whole; None where there is none yet. Raises InputError where all there is is damaged."""
    damaged: InputError | None = None
    for name in (STATE, STATE_BEFORE):
        path = out / name
        if not path.exists():
            continue
        try:
            with path.open("rb") as file:
                state = unpack_tensors(file, path.stat().st_size, str(path))[0]
        except InputError as error:
            damaged = damaged or error
            continue
        if damaged is not None:
            print(f"{damaged}; going on from {name}, which is older.", file=sys.stderr)
        return state
    if damaged is not None:
        raise damaged
    return None


def drop_states(out: Path) -> None:
    """Remove the states of a training that is finished, and what killed processes left of files under way."""
    for path in (out / STATE, out / STATE_BEFORE, *out.glob(".*.tmp")):
        with suppress(OSError):
            path.unlink(missing_ok=True)
