"""Files of every format that is read, damaged at random: each is read or refused in one sentence, and nothing else.

A few hundred inputs a format, always the same; LAPGS_FUZZ=10000 takes as many new ones (make soak). What was found so
far stands in test_hostile_found.py as plain tests; captures are in test_hostile_captures.py.
"""

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.damaged_files import (
    FOREIGN,
    KINDS,
    compact_scenes,
    short_config,
    small_scene,
    with_table,
)
from helpers.damaged_lapgs import CompactDamage, damage_compact, damaged_compact_scenes
from helpers.dnerf_scene import make_scene
from helpers.hostile import (
    ByteEdits,
    TreeEdits,
    byte_edits,
    edit_bytes,
    edit_tree,
    fuzzed,
    json_text,
    refused_or,
    toml_text,
    tree_edits,
)
from helpers.playback import open_playback
from hypothesis import given
from hypothesis import strategies as st

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.scene_file import read_scene
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.run_folder import STATE, check_state, load_state, save_state
from lapgs_wgpu.train.trainer import Trainer

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all inputs of a test, which write the same names again."""
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def checkpoints(device: Device, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """One of each field."""
    file = tmp_path_factory.mktemp("checkpoints") / "a.ply"
    found = []
    for kind in KINDS:
        small_scene(kind, device).save(file, {"step": "7", "background": "white"})
        found.append(file.read_bytes())
    return found


@pytest.fixture(scope="module")
def compact(device: Device, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    return compact_scenes(tmp_path_factory.mktemp("compact"), device)


@np.errstate(all="ignore")
def shown_at_all_times(file: Path, device: Device) -> None:
    playback = open_playback(file, device)
    InitialView.from_json(playback.metadata.get("view", ""))
    assert playback.at(0.5).means.read().shape == (playback.count, 3)
    assert len(playback.snapshot(1.0)) == playback.count


WORDS = [
    b"element vertex 4\n", b"element vertex 999999999999999999\n", b"property double x\n",
    b"property list uchar int x\n",
    b"end_header\n", b"comment lapgs4d v1 safetensors 4\n", b"format ascii 1.0\n", b"obj_info\n", b"f_rest_", b"double",
    b"uchar", b"element empty 999999999999999999\n", b"\r\n", b"lapgs4d", b"{\"a\":", b"\"shape\":[0,9007199254740991]",
    b"safetensors 18446744073709551615", b"packed_position",
]  # fmt: skip


@fuzzed()
@given(st.sampled_from(FOREIGN), byte_edits(WORDS))
def test_foreign_splats(folder: Path, data: bytes, edits: ByteEdits) -> None:
    (folder / "a.ply").write_bytes(edit_bytes(data, edits, head=data.index(b"end_header") + 20))
    scene = refused_or(lambda: read_scene(folder / "a.ply"))
    if scene is not None:
        assert all(np.isfinite(values).all() for values in scene.gaussians.values())


@fuzzed(400)
@given(st.integers(0, len(KINDS) - 1), st.sampled_from(["bytes", "table", "field"]), byte_edits(WORDS), tree_edits)
def test_checkpoints(
    checkpoints: list[bytes], device: Device, folder: Path, kind: int, place: str, edits: ByteEdits, changes: TreeEdits
) -> None:
    """Other bytes, another table of tensors, or another configuration of the field in its metadata."""

    def change(table: dict[str, Any]) -> bytes:
        if place == "table":
            return json_text(edit_tree(table, changes))
        values = edit_tree(json.loads(table["__metadata__"]["field"]), changes)
        table["__metadata__"]["field"] = json_text(values).decode("utf-8", "replace")
        return json_text(table)

    good = checkpoints[kind]
    damaged = edit_bytes(good, edits, head=4000) if place == "bytes" else with_table(good, change)
    (folder / "a.ply").write_bytes(damaged)
    refused_or(lambda: shown_at_all_times(folder / "a.ply", device))


@fuzzed()
@given(damaged_compact_scenes(4))
def test_compact_scenes(compact: list[bytes], device: Device, folder: Path, damage: CompactDamage) -> None:
    (folder / "a.lapgs").write_bytes(damage_compact(compact, damage))
    refused_or(lambda: shown_at_all_times(folder / "a.lapgs", device))


# The state of a training


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(tmp_path_factory.mktemp("scene") / "toy")


@pytest.fixture(scope="module")
def dataset(scene: Path) -> Dataset:
    return load_dataset(scene)


@pytest.fixture(scope="module")
def training(dataset: Dataset, device: Device) -> Trainer:
    training = Trainer(short_config(), dataset, device)
    training.step()
    return training


@pytest.fixture(scope="module")
def state(training: Trainer) -> dict[str, Any]:
    """Before any damage."""
    return training.state()


@fuzzed()
@given(byte_edits([b'"shape":[0', b'"dtype":"F64"', b'"I64"', b'"U8"'], least=0), tree_edits, st.booleans())
def test_states(
    training: Trainer,
    state: dict[str, Any],
    dataset: Dataset,
    folder: Path,
    edits: ByteEdits,
    changes: TreeEdits,
    whole: bool,
) -> None:
    """A state that is accepted is one that a training can go on from."""
    run = folder / "run"
    run.mkdir(exist_ok=True)
    save_state(run, state)
    data = (run / STATE).read_bytes()
    length = int.from_bytes(data[:8], "little")
    if whole:
        text = json_text(edit_tree(json.loads(data[8 : 8 + length]), changes))
        data = len(text).to_bytes(8, "little") + text + data[8 + length :]
    (run / STATE).write_bytes(edit_bytes(data, edits, head=length))
    for other in run.iterdir():
        if other.name != STATE:
            other.unlink()
    found = refused_or(lambda: load_state(run))
    if found is None:
        return
    try:
        check_state(found, views=len(dataset.train), steps=5)
        training.restore(found)
    except (IndexError, KeyError, RuntimeError, TypeError, ValueError):
        return  # what train.run.resume tells as an InputError
    assert 0 <= training.done <= 5
    assert len({len(value) for value in training.scene.parameters.values()}) == 1


# JSON and TOML


@fuzzed()
@given(tree_edits, byte_edits([b"\n", b"[", b'"'], least=0), st.integers(0, 9))
def test_logs(folder: Path, changes: TreeEdits, edits: ByteEdits, done: int) -> None:
    lines: list[Any] = [
        {"step": step, "loss": 0.1, "psnr": 20.0, "gaussians": 9, "frequencies": [0.0, 1.0], "amplitudes": [0.1, 0.2],
         "timing": {"seconds": 1.0, "steps_per_second": 2.0}}
        for step in (3, 6)
    ]  # fmt: skip
    data = b"\n".join(json_text(line) for line in edit_tree(lines, changes))
    (folder / "log.jsonl").write_bytes(edit_bytes(data, edits))
    with Log(folder / "log.jsonl", 10, done=done, terminal=io.StringIO()) as log:
        assert 0 <= log.seconds < 1e10


TOML_EDITS = (tree_edits, byte_edits([b"[", b"]", b"a.b.", b'"""', b"= "], least=0))


@fuzzed(300)
@given(*TOML_EDITS)
def test_configurations(folder: Path, changes: TreeEdits, edits: ByteEdits) -> None:
    tree = {**dataclasses.asdict(short_config()), "base": "tiny", "record": {"torch": "2"}}
    (folder / "config.toml").write_bytes(edit_bytes(toml_text(edit_tree(tree, changes)), edits))
    refused_or(lambda: load_config(str(folder / "config.toml")))
