"""Hostile files: the faults that fuzzing and reading found, links and pipes, and the bounds on memory and time."""

import io
import json
import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.damaged_files import FOREIGN, short_config, small_scene, with_table
from helpers.dnerf_scene import make_scene
from helpers.hostile import refused_or
from helpers.ply_files import columns_of, ply_bytes, random_still

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.folder_lock import locked_folder
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.io.safe_json_toml import MAX_TOML_BYTES, read_json, read_toml
from lapgs_wgpu.motion.scene_file import read_scene
from lapgs_wgpu.run import evaluate_run, resume
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.run_folder import STATE, check_same_data, load_state, save_state, start_run_folder
from lapgs_wgpu.train.step_result import Measured, StepResult
from lapgs_wgpu.train.trainer import Trainer

TABLE = "__metadata__"


def field_of(table: dict[str, Any], **changes: Any) -> bytes:
    """The table of tensors, with another configuration of the field."""
    table[TABLE]["field"] = json.dumps(json.loads(table[TABLE]["field"]) | changes)
    return json.dumps(table).encode()


def without_field(text: str) -> Callable[[dict[str, Any]], bytes]:
    """The table of tensors, with other text where the field's configuration stands."""
    return lambda table: json.dumps(table | {TABLE: table[TABLE] | {"field": text}}).encode()


# The text of a config.toml, or what makes the table of a checkpoint's tensors anew; and what the error names.
FOUND: list[tuple[str | Callable[[dict[str, Any]], bytes], str]] = [
    ("seed = " + "[" * 5000 + "]" * 5000, "nested"),
    ("[points]\n" + "count." * 20_000 + "a = 1", "dotted key"),
    ("a" + '."b".c' * 5000 + " = 1", "dotted key"),
    ("seed = 0x" + "f" * 9000, "seed"),
    ("rates.quats = 1" + "0" * 400, "rates.quats"),
    ('seed = "' + "x" * 100_000 + '"', "seed"),
    ('"\\u001b]0;title\\u0007" = 1', "\\x1b]0;title\\x07"),
    *((without_field(text), "field") for text in ("[" * 100_000, "9" * 5000, "null", '{"size": 1}')),
    # 4096 channels and 16 hidden layers are a gigabyte, which a file of some kB must not make us take.
    (lambda table: field_of(table, width=4096, depth=16), "tensor"),
]


@pytest.mark.parametrize("number", range(len(FOUND)))
def test_found_in_configurations_and_checkpoints(number: int, device: Device, tmp_path: Path) -> None:
    damage, named = FOUND[number]
    if isinstance(damage, str):
        (tmp_path / "a.toml").write_text(f'base = "tiny"\n{damage}\n')
    else:
        small_scene("grid4d", device).save(tmp_path / "a.ply")
        (tmp_path / "a.ply").write_bytes(with_table((tmp_path / "a.ply").read_bytes(), damage))
    with pytest.raises(InputError) as error:
        load_config(str(tmp_path / "a.toml")) if isinstance(damage, str) else read_scene(tmp_path / "a.ply")
    assert named in str(error.value)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 2100


@pytest.mark.parametrize("arc", [[], [1, 2, 3], "ab", 7, {"a": 1}, [-1, 20], [200, 200], [float("nan"), 1], [[1], 2]])
def test_a_place_to_look_from_is_left_out_where_it_is_no_good(arc: object) -> None:
    camera = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=8, height=6)
    look = InitialView(camera, np.zeros(3), np.array([0.0, 0.0, 1.0]), 3, (10.0, 20.0))
    values = json.loads(look.to_json())
    assert InitialView.from_json(json.dumps(values)) is not None
    for text in (json.dumps(values | {"arc": arc}), "[" * 100_000, "9" * 5000, "null", '{"size": 1}'):
        assert InitialView.from_json(text) is None


def test_found_in_states(device: Device, tmp_path: Path) -> None:
    config, dataset = short_config(), load_dataset(make_scene(tmp_path / "toy"))
    training = Trainer(config, dataset, device)
    training.step()
    state = training.state()
    training.close()
    wrong: dict[str, Any] = {
        "training.done": np.array(-1),
        "training.sh_degree": np.array(99),
        "training.order": np.array([7]),
        "gaussians.quats": state["gaussians.quats"][:-1],
        "gaussians.means": state["gaussians.means"].astype(np.float64),
        "statistics.views": state["statistics.views"][:-1],
        "training.random": state["training.random"].astype(np.int32),
        "adam.means.0.exp_avg": state["adam.means.0.exp_avg"][:-1],
        "frequencies.mean": np.zeros(1, np.float32),
    }
    for name, value in wrong.items():
        save_state(tmp_path, {**state, name: value})
        with pytest.raises(InputError, match="do not belong together"):
            resume(config, dataset, tmp_path, device=device)
    save_state(tmp_path, state)
    resume(config, dataset, tmp_path, device=device)


def test_found_in_a_run_folder(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text('record = "x"\n')
    check_same_data(tmp_path, "there", SimpleNamespace(fingerprint="1"))  # type: ignore[arg-type]


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    """A run folder from elsewhere, whose files are links to ours."""
    run, mine = tmp_path / "run", tmp_path / "mine"
    run.mkdir()
    mine.mkdir()
    (mine / "file").write_text("precious")
    (run / ".lock").symlink_to(mine / "file")
    with pytest.raises(OSError, match="symbolic link"), locked_folder(run):
        pass
    (run / ".lock").unlink()
    (run / "eval").symlink_to(mine)
    with pytest.raises(InputError, match="eval is a link"):
        evaluate_run(run, None, None, None, {})  # type: ignore[arg-type]
    for name in ("config.toml", "log.jsonl", STATE):
        (run / name).symlink_to(mine / "file")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lapgs_wgpu.train.run_folder.environment", lambda device: {})
        start_run_folder(run, load_config("tiny"), SimpleNamespace(is_cpu=False), SimpleNamespace(fingerprint="1"))
    save_state(run, {"training.done": np.array(1)})
    with Log(run / "log.jsonl", 1, terminal=io.StringIO()) as log:
        log.step(StepResult(1, 1, lambda: Measured(0.5, 10.0)), 3)
    assert [file.name for file in mine.iterdir()] == ["file"]
    assert (mine / "file").read_text() == "precious"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_and_devices_do_not_hang(tmp_path: Path) -> None:
    for name in ("a.json", "a.toml", STATE):
        os.mkfifo(tmp_path / name)
    (tmp_path / "zero.json").symlink_to("/dev/zero")
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    actions: list[Callable[[], Any]] = [
        lambda: read_json(tmp_path / "a.json"),
        lambda: read_json(tmp_path / "zero.json"),
        lambda: read_toml(tmp_path / "a.toml"),
        lambda: read_toml(tmp_path / "zero.toml"),
        lambda: load_state(tmp_path),
    ]
    for action in actions:
        with pytest.raises(InputError, match="not a regular file"):
            action()


# Bounds on memory (docs/reliability.md)


def peak_of(action: Callable[[], Any]) -> int:
    tracemalloc.start()
    try:
        refused_or(action)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("part", ["[],", '{"":0},', "[" * 30 + "0" + "]" * 30 + ","])
def test_json_takes_at_most_64_times_its_size(part: str, tmp_path: Path) -> None:
    size = 1 << 18
    (tmp_path / "a.json").write_text("[" + part * (size // len(part)) + "0]")
    assert peak_of(lambda: read_json(tmp_path / "a.json")) < 64 * size + (1 << 20)


def test_toml_of_the_largest_size_is_quick(tmp_path: Path) -> None:
    line = ".".join("abcdefghijklmno") + ".{} = 1\n"
    text = "".join(line.format(f"k{i}") for i in range(MAX_TOML_BYTES // (len(line) + 4)))
    (tmp_path / "a.toml").write_text(text)
    program = "import sys; from lapgs_wgpu.io.safe_json_toml import read_toml; read_toml(sys.argv[1])"
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.toml")], check=True, timeout=60)
    (tmp_path / "a.toml").write_text("#" * (MAX_TOML_BYTES + 1))
    with pytest.raises(InputError, match=str(MAX_TOML_BYTES)):
        read_toml(tmp_path / "a.toml")


def test_splats_take_at_most_24_times_the_file(tmp_path: Path) -> None:
    """The smallest rows, of 17 bytes, become 236 bytes each: harmonics are padded to degree 3."""
    ones = np.ones(100_000, int)
    data = ply_bytes(dict.fromkeys(columns_of(random_still(1, 0)), ("uchar", ones)))
    (tmp_path / "a.ply").write_bytes(data)
    assert peak_of(lambda: read_scene(tmp_path / "a.ply")) < 24 * len(data) + (16 << 20)


@pytest.mark.skipif(sys.platform != "linux", reason="needs RLIMIT_AS")
def test_sizes_that_a_file_only_declares_take_no_memory(tmp_path: Path) -> None:
    """In a process that may not take a gigabyte more than it has: reading in whole, header by header."""
    names = []
    for number, (count, tensors) in enumerate([(10**17, 8), (2, 2**63), (10**9, 10**15)]):
        head = FOREIGN[0].replace(b"element vertex 4", b"element vertex %d" % count)
        trailer = b"element lapgs4d %d\ncomment lapgs4d v1 safetensors %d\nproperty uint word\nend_header\n"
        (tmp_path / f"{number}.ply").write_bytes(head.replace(b"end_header\n", trailer % (tensors // 4, tensors)))
        names.append(str(tmp_path / f"{number}.ply"))
    program = (
        "import resource, sys; from lapgs_wgpu.motion.scene_file import read_scene; "
        "from lapgs_wgpu.errors import InputError\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 28),) * 2)\n"
        "for name in sys.argv[1:]:\n    try: read_scene(name)\n    except InputError: print('refused')"
    )
    told = subprocess.run([sys.executable, "-c", program, *names], capture_output=True, text=True, timeout=120)
    assert told.stdout.split() == ["refused"] * 3, told.stderr


@pytest.mark.nightly
def test_a_hostile_checkpoint_ends_the_command_in_one_sentence(device: Device, tmp_path: Path) -> None:
    """The whole way: no traceback, exit code 2; a step that is no number does not matter."""
    small_scene("grid4d", device).save(tmp_path / "checkpoint.ply", {"step": "x\x1b"})
    (tmp_path / "config.toml").write_text("seed = " + "[" * 3000)
    command = [sys.executable, "-m", "lapgs_wgpu.cli", "--eval", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
