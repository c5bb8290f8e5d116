"""The folder of a run: what lies in it, who may write to it, and the state from which a training goes on."""

import dataclasses
import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.folder_lock import LOCK
from lapgs_wgpu.io.listing import listed
from lapgs_wgpu.io.safe_json_toml import open_regular, read_toml
from lapgs_wgpu.io.safetensors_file import pack_tensors, unpack_tensors
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.host import environment, step_threads
from lapgs_wgpu.train.presets import write_toml

LOST = 0.8  # share of the moving pixels; where fewer are drawn as they are, that is a warning
STATE = "state.safetensors"  # from which a training goes on; a finished one has none
# Of a run, and of older versions. config.toml, by which --overwrite knows a run, is replaced at once instead.
RUN_FILES = ("log.jsonl", "metrics.json", "metrics.csv", "checkpoint.ply", "eval", "tensorboard", STATE)

State = Mapping[str, NDArray[Any]]


def check_run_folder(out: Path, *, overwrite: bool) -> None:
    """Raises InputError where a run cannot be written there."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; name a folder for the run with --out.")
    if not out.exists() or all(entry.name == LOCK or entry.match(".*.tmp") for entry in listed(out)):
        return
    if not overwrite:
        goes_on = ", go on with its interrupted run with --resume" if (out / STATE).is_file() else ""
        raise InputError(f"{out} is not empty; name another with --out{goes_on}, or replace its run with --overwrite.")
    if not (out / "config.toml").is_file() or not (_recorded(out) or (out / "log.jsonl").is_file()):
        raise InputError(f"{out} holds files, but no run that --overwrite could replace; name another with --out.")


def start_run_folder(out: Path, config: Config, device: Device, dataset: Dataset) -> None:
    """Free the folder of an earlier run's files, and write config.toml."""
    for name in RUN_FILES:
        if (out / name).is_dir() and not (out / name).is_symlink():
            shutil.rmtree(out / name)
        else:
            (out / name).unlink(missing_ok=True)
    _write_config(out, config, _record(config, device, dataset))


def changes_since(out: Path, config: Config, device: Device, dataset: Dataset) -> list[tuple[str, str, str]]:
    """Name, former and present value of what a run's bits depend on, where it has changed since the run began."""
    now, then = _record(config, device, dataset), _recorded(out)
    return [(name, then[name][:200], now[name]) for name in now if then.get(name, now[name]) != now[name]]


def check_same_data(out: Path, folder: str, dataset: Dataset) -> None:
    """Raises InputError where a folder that was given for the capture of a run holds another capture."""
    then = _recorded(out).get("data", dataset.fingerprint)
    if then != dataset.fingerprint:
        raise InputError(
            f"{folder} is another capture than that of {out / 'config.toml'} (fingerprints {dataset.fingerprint} and "
            f"{then[:16]}, of cameras, times and file sizes); give --data the folder of that one."
        )


def note_paths(out: Path, config: Config) -> None:
    """Let config.toml name the folder where the capture is now."""
    try:
        known = read_toml(out / "config.toml")["data"]["path"]
    except (InputError, KeyError, TypeError):
        return
    if known != config.data.path:
        _write_config(out, config, _recorded(out))


def _write_config(out: Path, config: Config, record: dict[str, str]) -> None:
    with atomic_write(out / "config.toml") as file:
        file.write(write_toml({**dataclasses.asdict(config), "record": record}).encode())


def _record(config: Config, device: Device, dataset: Dataset) -> dict[str, str]:
    """What the bits of a run depend on besides its configuration."""
    record = {**environment(device), "data": dataset.fingerprint}
    threads = step_threads(config.field, device)
    return record if threads is None else {**record, "torch_threads": str(threads)}


def _recorded(out: Path) -> dict[str, str]:
    """What config.toml of a run says of how it began; empty where it says nothing."""
    try:
        record = read_toml(out / "config.toml").get("record")
    except InputError:
        return {}
    texts = record.items() if isinstance(record, dict) else ()
    return {name: text for name, text in texts if isinstance(text, str) and text.isprintable()}


def result_text(run: Path) -> str:
    """What metrics.json of a finished run says, in a line; before it, where masks tell, what became of what moves."""
    metrics = json.loads((run / "metrics.json").read_text())
    width, height = metrics["size"]
    moving = ""
    if isinstance(explained := metrics.get("explained"), float):
        moving = f"what moves: {metrics['psnr_moving']:.2f} dB, {explained:.0%} of its pixels are drawn as they are\n"
        if explained < LOST:
            moving = (
                f"warning: {1 - explained:.0%} of what moves in the test views is not drawn as it is, which "
                f"{run / 'eval'} shows; film slower, or train with more steps.\n"
            )
    return moving + (
        f"{run}: {metrics['psnr']:.2f} dB PSNR, {metrics['ssim']:.4f} SSIM on {len(metrics['views'])} test views of "
        f"{width}x{height}, {metrics['gaussians']} Gaussians"
    )


def save_state(out: Path, state: State) -> None:
    """Write the state of a training, or leave the one before as it is and raise InputError."""
    with atomic_write(out / STATE) as file:
        for buffer in pack_tensors(state, {}):
            file.write(buffer)


def load_state(out: Path) -> dict[str, NDArray[Any]] | None:
    """The state that was saved last; None where there is none. Raises InputError where it is damaged."""
    path = out / STATE
    if not path.exists():
        return None
    with open_regular(path) as file:
        return unpack_tensors(file, path.stat().st_size, str(path))[0]


def check_state(state: State, *, views: int, steps: int) -> None:
    """Check that a state matches view and step counts, and is consistent. Raises KeyError or ValueError."""
    for name, dimensions, most in (("done", 0, steps), ("sh_degree", 0, 3), ("order", 1, views - 1)):
        value = state[f"training.{name}"]
        if value.ndim != dimensions or value.dtype.kind != "i" or not ((value >= 0) & (value <= most)).all():
            raise ValueError(f"its {name} is not made of whole numbers from 0 to {most}")
    count = state["gaussians.means"].shape[:1]
    for name, array in state.items():
        part = name.partition(".")[0]
        rows = array.shape == count if part == "statistics" else array.shape[:1] == count
        if part in ("gaussians", "statistics") and (array.dtype != np.float32 or not rows or count == (0,)):
            raise ValueError(f"its {name} is {array.dtype} of shape {array.shape}")


def drop_states(out: Path) -> None:
    """Remove the state of a training that is finished, and temporary files of killed processes."""
    for path in (out / STATE, *out.glob(".*.tmp")):
        with suppress(OSError):
            path.unlink(missing_ok=True)
