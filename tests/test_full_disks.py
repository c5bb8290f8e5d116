"""Full, broken and read-only disks: one sentence, the exit code 2, and what was saved before is still there and good.

Errors are injected at the operations of a run, and of the viewer, that change the disk (faults.py). LAPGS_FUZZ tries
every operation with every error; the nightly suite takes one error an operation, in turn.
"""

import dataclasses
import errno
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from helpers.faults import FAILING, Disk
from helpers.training import configure
from synthetic import write_synthetic

from lapgs_wgpu import cli
from lapgs_wgpu.gpu import device as device_module
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.presets import write_toml
from lapgs_wgpu.train.run_folder import load_state
from lapgs_wgpu.viewer.cli import view_command

EVERY = bool(os.environ.get("LAPGS_FUZZ"))
ERRORS = list(FAILING)


@pytest.fixture(autouse=True)
def one_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "open_device", lambda name=None: device)


@pytest.fixture(scope="module")
def preset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of four steps that saves after each."""
    folder = tmp_path_factory.mktemp("preset")
    data = write_synthetic(folder / "scene", size=16, train_views=3, test_views=1)
    config: Config = configure("static", data__path=str(data), schedule__steps="4", schedule__save_interval="1",
                               points__count="30")  # fmt: skip
    (folder / "short.toml").write_text(write_toml(dataclasses.asdict(config)))
    return folder / "short.toml"


class Whole(NamedTuple):
    """What a whole run does to the disk: kinds of operations and paths; and its checkpoint."""

    operations: list[tuple[str, str]]
    checkpoint: bytes

    def state(self, number: int) -> int:
        """The operation that begins to write the state of this number."""
        created = [i for i, (kind, name) in enumerate(self.operations) if kind == "create" and ".state." in name]
        return created[number]


@pytest.fixture(scope="module")
def whole(preset: Path, device: Device, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    out = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(device_module, "open_device", lambda name=None: device)
        disk = Disk(out)
        disk.install(patch)
        assert cli.train_command([str(preset), "--out", str(out)]) == 0
    return Whole(disk.operations, (out / "checkpoint.ply").read_bytes())


def told(error: str, command: str, disk: Disk) -> None:
    """One line on stderr says what went wrong; it names a path and says what to do."""
    lines = [line for line in error.splitlines() if line.startswith(f"{command}: ")]
    assert len(lines) == 1, error
    assert "Traceback" not in error
    assert disk.folder in lines[0]
    assert os.strerror(disk.code) in lines[0]
    assert "free" in lines[0] or "check" in lines[0]


def test_every_file_of_a_run_is_counted_and_forced_to_the_disk(whole: Whole) -> None:
    assert {kind for kind, _ in whole.operations} == {"create", "write", "fsync", "replace", "unlink", "mkdir"}
    for file in ("config.toml", "log.jsonl", "state.safetensors", "checkpoint.ply", "metrics.json", "test_000.png"):
        assert any(kind == "fsync" and f".{file}." in name for kind, name in whole.operations), file


def test_the_state_before_is_what_a_failed_write_leaves(
    preset: Path, whole: Whole, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """While the third state is written: the second is whole, and the run goes on from it to the same bytes."""
    out = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(out, errno.ENOSPC, whole.state(2) + 1)
        disk.install(patch)
        assert cli.train_command([str(preset), "--out", str(out)]) == 2
    told(capfd.readouterr().err, "lapgs-train", disk)
    state = load_state(out)
    assert state is not None
    assert int(state["training.done"]) == 2
    assert cli.train_command(["--resume", str(out)]) == 0
    assert (out / "checkpoint.ply").read_bytes() == whole.checkpoint


@pytest.mark.nightly
def test_a_training_at_every_operation(
    preset: Path, whole: Whole, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Once the disk is good again, the run goes on to the same bytes from what was saved."""
    done = whole.operations
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
                kind, name = next((each for each in done[first:] if each[0] in FAILING[code]), done[first])
                folder = kind == "fsync" and ".tmp" not in Path(name).name
                assert disk.failed <= (code in (errno.EROFS, errno.EACCES) or folder or kind == "write"), where
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
            assert (out / "checkpoint.ply").read_bytes() == whole.checkpoint, where
            assert (out / "metrics.json").exists(), where
    assert failures > 3


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


@pytest.mark.parametrize(
    "name", ["a.ply", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("a.png", "a.mp4"))]
)
def test_the_viewers_files(name: str, still: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    if name == "a.mp4":
        pytest.importorskip("av")
    command, file = [str(still), *OUTPUTS[name], str(tmp_path / name)], tmp_path / name
    file.write_bytes(b"the old one")
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(tmp_path)
        disk.install(patch)
        assert view_command(command) == 0
    kinds = [kind for kind, _ in disk.operations]
    capfd.readouterr()
    for first, code in ((first, code) for first in range(len(kinds)) for code in ERRORS):
        if kinds[first] not in FAILING[code] or "replace" not in kinds[first:]:
            continue  # the last operation forces the folder to the disk, which not every file system does
        file.write_bytes(b"the old one")
        with pytest.MonkeyPatch.context() as patch:
            disk = Disk(tmp_path, code, first)
            disk.install(patch)
            assert view_command(command) == 2
        told(capfd.readouterr().err, "lapgs-view", disk)
        assert file.read_bytes() == b"the old one"
        for left in tmp_path.glob(".*.tmp"):
            assert code in (errno.EROFS, errno.EACCES)  # which do not let it be removed
            left.unlink()
