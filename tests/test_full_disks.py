"""Full, broken and read-only disks: one sentence, the exit code 2, and what was saved before is still there and good.

Errors are injected at every operation of a run, and of the viewer, that changes the disk (faults.py); real full disks
follow where this machine can have one. LAPGS_FUZZ tries every operation with every error; the suite takes one error an
operation, in turn.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.camera_paths import keys
from helpers.faults import FAILING, Disk
from helpers.ply_files import read_ply
from helpers.training import configure

from lapgs_wgpu import cli
from lapgs_wgpu.data.synthetic import write_synthetic
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu import device as device_module
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.presets import write_toml
from lapgs_wgpu.train.run_folder import load_state
from lapgs_wgpu.viewer.cli import view_command
from lapgs_wgpu.viewer.path import CameraPath
from lapgs_wgpu.viewer.path_file import PathFile, read_path, write_path

pytestmark = pytest.mark.nightly

EVERY = bool(os.environ.get("LAPGS_FUZZ"))
ERRORS = list(FAILING)


@pytest.fixture(autouse=True)
def one_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "open_device", lambda name=None, **_: device)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("data") / "scene", size=16, train_views=3, test_views=1)


@pytest.fixture(scope="module")
def preset(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of four steps that saves after each."""
    config: Config = configure("static", data__path=str(data), schedule__steps="4", schedule__save_interval="1",
                               points__count="30")  # fmt: skip
    file = tmp_path_factory.mktemp("preset") / "short.toml"
    file.write_text(write_toml(dataclasses.asdict(config)))
    return file


@pytest.fixture(scope="module")
def operations(
    preset: Path, device: Device, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[tuple[str, str]], bytes]:
    """What a whole run does to the disk, and its checkpoint."""
    out = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(device_module, "open_device", lambda name=None, **_: device)
        disk = Disk(out)
        disk.install(patch)
        assert cli.train_command([str(preset), "--out", str(out)]) == 0
    return disk.operations, (out / "checkpoint.ply").read_bytes()


def told(error: str, command: str, disk: Disk) -> str:
    """The one line on stderr that says what went wrong; it names a path and says what to do."""
    lines = [line for line in error.splitlines() if line.startswith(f"{command}: ")]
    assert len(lines) == 1, error
    assert "Traceback" not in error
    assert disk.folder in lines[0]
    assert os.strerror(disk.code) in lines[0]
    assert "free" in lines[0] or "check" in lines[0]
    return lines[0]


def test_a_run_does_what_the_faults_are_put_into(operations: tuple[list[tuple[str, str]], bytes]) -> None:
    """That nothing escapes the counting: every file of a run is created, written, forced to the disk, and renamed."""
    assert {kind for kind, _ in operations[0]} == {"create", "write", "fsync", "replace", "unlink", "mkdir"}
    for file in ("config.toml", "log.jsonl", "state.safetensors", "checkpoint.ply", "metrics.json", "test_000.png"):
        assert any(kind == "fsync" and f".{file}." in name for kind, name in operations[0]), file
    assert sum(kind == "write" and name.endswith("log.jsonl") for kind, name in operations[0]) == 1


def test_a_training_at_every_operation(
    preset: Path,
    operations: tuple[list[tuple[str, str]], bytes],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Once the disk is good again, the run goes on to the same bytes from what was saved."""
    done, expected = operations
    failures = 0
    # The first and the last of its kind on each file, as the states in between are written like these.
    kinds = [(kind, Path(name).name.partition(".tmp")[0].rpartition(".")[0]) for kind, name in done]
    ends = {*({kind: i for i, kind in enumerate(kinds)}.values()), *(kinds.index(kind) for kind in kinds)}
    for turn, first in enumerate(range(len(done)) if EVERY else sorted(ends)):
        for code in ERRORS if EVERY else [ERRORS[turn % len(ERRORS)]]:
            out = tmp_path / f"run{first}-{code}"
            with pytest.MonkeyPatch.context() as patch:
                disk = Disk(out, code, first)
                disk.install(patch)
                exit_code = cli.train_command([str(preset), "--out", str(out)])
            error = capfd.readouterr().err
            where = f"operation {first} of {len(done)}, {done[first]}, {os.strerror(code)}\n{error}"
            if exit_code == 0:  # it can do without, for example without removing what is not needed any more
                assert disk.failed <= (code in (errno.EROFS, errno.EACCES) or done[first][0] == "write"), where
            else:
                failures += 1
                assert exit_code == 2, where
                told(error, "lapgs-train", disk)
                if (out / "config.toml").exists() and not (out / "metrics.json").exists():
                    saved = sum(kind == "replace" and ".state.safetensors." in name for kind, name in done[:first])
                    assert load_state(out) is not None or saved == 0, where
                    again = ["--resume", str(out)]
                else:
                    again = [str(preset), "--out", str(out), "--overwrite"]
                assert cli.train_command(again) == 0, where
                capfd.readouterr()
            assert (out / "checkpoint.ply").read_bytes() == expected, where
            assert (out / "metrics.json").exists(), where
    assert failures > 3


def test_the_state_before_is_what_a_failed_write_leaves(
    preset: Path, operations: tuple[list[tuple[str, str]], bytes], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """At each operation of the third state's writing: the second is there, and is whole."""
    done, _ = operations
    states = [number for number, (kind, name) in enumerate(done) if kind == "create" and ".state.safetensors." in name]
    for first in range(states[2], states[3]):
        out = tmp_path / f"run{first}"
        with pytest.MonkeyPatch.context() as patch:
            Disk(out, errno.EIO, first).install(patch)
            code = cli.train_command([str(preset), "--out", str(out)])
        capfd.readouterr()
        state = load_state(out)
        assert code == 2
        assert state is not None
        assert int(state["training.done"]) in (2, 3)


# The viewer ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("still") / "still.ply"
    Scene4D.from_points(np.eye(3), np.eye(3), np.full(3, 0.2), FieldConfig(kind="static"), device=device).save(file)
    return file


OUTPUTS = {
    "a.png": ["--size", "16x16", "--screenshot"],
    "a.mp4": ["--size", "16x16", "--seconds", "0.2", "--fps", "10", "--video"],
    "a.ply": ["--overwrite", "--export"],
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_the_viewers_files(name: str, still: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    command = [str(still), *OUTPUTS[name], str(tmp_path / name)]
    if name == "a.mp4":
        pytest.importorskip("av")
    (tmp_path / name).write_bytes(b"the old one")
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(tmp_path)
        disk.install(patch)
        assert view_command(command) == 0
    kinds = [kind for kind, _ in disk.operations]
    assert kinds[0] == "create"
    whole = (tmp_path / name).read_bytes()
    capfd.readouterr()
    for first in range(len(kinds)):
        for code in ERRORS:
            if kinds[first] not in FAILING[code]:
                continue
            (tmp_path / name).write_bytes(b"the old one")
            with pytest.MonkeyPatch.context() as patch:
                disk = Disk(tmp_path, code, first)
                disk.install(patch)
                assert view_command(command) == 2
            line = told(capfd.readouterr().err, "lapgs-view", disk)
            assert name in line
            assert (tmp_path / name).read_bytes() in (b"the old one", whole)
            if kinds[first:].count("replace"):
                assert (tmp_path / name).read_bytes() == b"the old one"
            for file in tmp_path.glob(".*.tmp"):
                assert code in (errno.EROFS, errno.EACCES)  # which do not let it be removed
                file.unlink()


def test_camera_paths(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_path(file, PathFile(CameraPath(keys()), (64, 36), 24.0))
    before = file.read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(tmp_path)
        disk.install(patch)
        write_path(file, PathFile(CameraPath(keys()), (64, 36), 24.0))
    for first in range(len(disk.operations) - 1):  # the last one forces the folder, when all is done
        with pytest.MonkeyPatch.context() as patch:
            Disk(tmp_path, errno.EIO, first).install(patch)
            with pytest.raises(InputError, match=r"a\.json: not written \(Input/output error\).*free some space"):
                write_path(file, PathFile(CameraPath(keys(1)), (32, 36), 24.0))
        assert file.read_bytes() == before
    assert read_path(file).size == (64, 36)


def test_a_sequence_of_stills_keeps_those_that_are_whole(
    device: Device, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from helpers.damaged_files import small_scene

    small_scene("mlp", device).save(tmp_path / "a.ply")
    folder = tmp_path / "frames"
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(folder)
        disk.install(patch)
        assert view_command([str(tmp_path / "a.ply"), "--export", str(folder), "--frames", "3"]) == 0
    second = [i for i, (kind, _) in enumerate(disk.operations) if kind == "create"][1]
    folder = tmp_path / "more frames"
    with pytest.MonkeyPatch.context() as patch:
        Disk(folder, errno.ENOSPC, second).install(patch)
        code = view_command([str(tmp_path / "a.ply"), "--export", str(folder), "--frames", "3"])
    assert code == 2
    told(capfd.readouterr().err, "lapgs-view", Disk(folder))
    assert [file.name for file in folder.iterdir()] == ["frame_0000.ply"]
    read_ply(folder / "frame_0000.ply")


# Real ones -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def half(preset: Path, device: Device, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Path:
    """A run that was interrupted after its second state."""
    from helpers.interrupts import interrupt_at

    out = tmp_path / "half" / "run"
    with pytest.MonkeyPatch.context() as patch:
        interrupt_at(2, patch)
        assert cli.train_command([str(preset), "--out", str(out)]) == 130
    capfd.readouterr()
    return out


def fails_and_keeps_the_state(out: Path, reason: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.train_command(["--resume", str(out)]) == 2
    error = capfd.readouterr().err
    assert "Traceback" not in error
    assert reason in error
    assert "free some space" in error
    state = load_state(out)
    assert state is not None
    assert int(state["training.done"]) == 2


def test_a_limit_on_the_size_of_files(
    half: Path, operations: tuple[list[tuple[str, str]], bytes], capfd: pytest.CaptureFixture[str]
) -> None:
    """What quotas and ulimit do, without root: a write stops in the middle of the state."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6000, limits[1]))
    try:
        fails_and_keeps_the_state(half, "File too large", capfd)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert cli.train_command(["--resume", str(half)]) == 0
    assert (half / "checkpoint.ply").read_bytes() == operations[1]


def test_a_full_file_system(
    half: Path, operations: tuple[list[tuple[str, str]], bytes], capfd: pytest.CaptureFixture[str]
) -> None:
    """A tmpfs that holds one state and not two."""
    disk = half.parent
    size = sum(file.stat().st_size for file in half.rglob("*") if file.is_file())
    files = {file.name: file.read_bytes() for file in half.iterdir()}
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={(size >> 10) + 20}k", "none", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("only root may mount a small file system")
    try:
        half.mkdir()
        for name, content in files.items():
            (half / name).write_bytes(content)
        fails_and_keeps_the_state(half, "No space left on device", capfd)
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        assert cli.train_command(["--resume", str(half)]) == 0
        assert (half / "checkpoint.ply").read_bytes() == operations[1]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_terminal_that_cannot_be_written_to_stops_no_training(
    preset: Path, operations: tuple[list[tuple[str, str]], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with contextlib.suppress(OSError), open("/dev/full", "w", buffering=1) as full:  # closing it fails, too
        with pytest.raises(OSError, match="No space left"):
            print("a line", file=full)
        monkeypatch.setattr(sys, "stderr", full)
        assert cli.train_command([str(preset), "--out", str(tmp_path / "run")]) == 0
    assert (tmp_path / "run" / "checkpoint.ply").read_bytes() == operations[1]
