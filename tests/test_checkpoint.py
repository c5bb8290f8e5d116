"""The checkpoint: its bytes, what it gives back, and what a hostile one cannot do."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from helpers.ply_files import INRIA, assert_same, mutate, random_still, read_ply
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.checkpoint import read_checkpoint, write_checkpoint
from lapgs_wgpu.io.ply import write_ply
from lapgs_wgpu.io.safetensors_file import MAX_HEADER_BYTES, pack_tensors

STILL = random_still(4)
TENSORS = {
    "means": np.arange(12, dtype=np.float32).reshape(4, 3),
    "field.tables": np.linspace(-1, 1, 6).reshape(1, 2, 3),
    "field.levels": np.array([16, 32], np.int64),
    "half": np.array([1.5, -2], np.float16),
    "bytes": np.arange(5, dtype=np.uint8),
    "step": np.array(7, np.int32),
    "none": np.zeros((0, 3), np.float32),
}
METADATA = {"config": '{"a": 1}', "name": "Kügelchen", "b": "", "a": "x\n\"y\""}  # fmt: skip


def assert_equal_tensors(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    assert a.keys() == b.keys()
    for name, array in a.items():
        assert array.dtype == b[name].dtype, name
        assert array.shape == b[name].shape, name
        np.testing.assert_array_equal(array, b[name], err_msg=name)


def payload_of(path: Path) -> bytes:
    """The safetensors bytes of a checkpoint, cut out by hand."""
    data = path.read_bytes()
    size = int(data.partition(b"safetensors ")[2].split(b"\n")[0])
    words = -(-size // 4)
    return data[len(data) - 4 * words :][:size]


def test_header_is_exactly_the_documented_one(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, TENSORS, METADATA)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    size = sum(map(len, pack_tensors(TENSORS, METADATA)))
    words = (size + 3) // 4
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 4",
        *(f"property float {name}" for name in INRIA),
        f"element lapgs4d {words}",
        f"comment lapgs4d v1 safetensors {size}",
        "property uint word",
    ]
    assert len(body) == 4 * 62 * 4 + 4 * words
    write_ply(tmp_path / "still.ply", STILL)  # the Gaussians' bytes are those of a plain file
    assert body[: 4 * 62 * 4] == (tmp_path / "still.ply").read_bytes()[-4 * 62 * 4 :]


def test_round_trip(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, TENSORS, METADATA)
    still, tensors, metadata = read_checkpoint(tmp_path / "a.ply")
    assert_same(still, STILL)
    assert_equal_tensors(tensors, TENSORS)
    assert metadata == METADATA
    assert all(array.flags.writeable and array.flags.aligned for array in tensors.values())
    assert_same(read_ply(tmp_path / "a.ply"), STILL)


@pytest.mark.parametrize("n", range(5))
def test_payload_is_padded_to_whole_words(tmp_path: Path, n: int) -> None:
    tensors = {"a": np.arange(n, dtype=np.uint8)}
    write_checkpoint(tmp_path / "a.ply", STILL, tensors, {})
    assert_equal_tensors(read_checkpoint(tmp_path / "a.ply").tensors, tensors)


def test_nothing_but_gaussians(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, {}, {})
    write_ply(tmp_path / "b.ply", STILL)
    for name in ["a.ply", "b.ply"]:  # without the element too, a file is a static scene
        still, tensors, metadata = read_checkpoint(tmp_path / name)
        assert_same(still, STILL)
        assert tensors == {}
        assert metadata == {}


def test_the_safetensors_package_reads_what_is_written(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, TENSORS, METADATA)
    payload = payload_of(tmp_path / "a.ply")
    assert_equal_tensors(safetensors.numpy.load(payload), TENSORS)
    (tmp_path / "a.safetensors").write_bytes(payload)
    with safetensors.safe_open(tmp_path / "a.safetensors", "numpy") as file:
        assert file.metadata() == METADATA


def test_reads_what_the_safetensors_package_writes(tmp_path: Path) -> None:
    path = checkpoint_file(tmp_path, safetensors.numpy.save(TENSORS, METADATA))
    assert_equal_tensors(read_checkpoint(path).tensors, TENSORS)
    assert read_checkpoint(path).metadata == METADATA


@pytest.mark.parametrize("length", range(8))
def test_tensors_are_aligned_to_their_items(length: int) -> None:
    header = pack_tensors(TENSORS, {"a": "b" * length})[0]
    for name, entry in json.loads(header[8:]).items():
        if name != "__metadata__":
            assert (len(header) + entry["data_offsets"][0]) % TENSORS[name].itemsize == 0


def test_bytes_depend_on_the_content_alone(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, TENSORS, METADATA)
    other = {name: array.astype(array.dtype.newbyteorder(">"), order="F") for name, array in reversed(TENSORS.items())}
    other["means"] = np.repeat(TENSORS["means"], 2, axis=1)[:, ::2]  # not contiguous
    write_checkpoint(tmp_path / "b.ply", STILL, other, dict(reversed(METADATA.items())))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_bytes_are_equal_in_every_process(tmp_path: Path) -> None:
    program = """
import sys
import numpy as np
from lapgs_wgpu.io.checkpoint import write_checkpoint
from lapgs_wgpu.io.ply import GaussianSnapshot
names = set("abcdefghijkl")  # a set: its order differs between processes
x = np.arange(48, dtype=np.float32)
write_checkpoint(
    sys.argv[1],
    GaussianSnapshot(x[:9].reshape(3, 3), x[:9].reshape(3, 1, 3), x[:3], x[:9].reshape(3, 3), x[:12].reshape(3, 4)),
    {name: np.full(3, ord(name), np.float32) for name in names},
    {name: name.upper() for name in names},
)
"""
    digests = set()
    for seed in ["0", "1", "2"]:
        subprocess.run(
            [sys.executable, "-c", program, tmp_path / "a.ply"], check=True, env={**os.environ, "PYTHONHASHSEED": seed}
        )
        digests.add(hashlib.sha256((tmp_path / "a.ply").read_bytes()).hexdigest())
    assert len(digests) == 1


# Files that lie. Each entry: the safetensors bytes, or a function of the whole file, and words of the refusal.


def safetensors_bytes(header: Any, data: bytes = b"", length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return (len(text) if length is None else length).to_bytes(8, "little") + text + data


def checkpoint_file(folder: Path, payload: bytes, **changes: str) -> Path:
    """A checkpoint around any payload; `changes` replace the lines of its element."""
    path = folder / "a.ply"
    write_ply(path, STILL)
    lines = {
        "element": f"element lapgs4d {-(-len(payload) // 4)}",
        "comment": f"comment lapgs4d v1 safetensors {len(payload)}",
        "property": "property uint word",
    } | changes
    trailer = "".join(f"{line}\n" for line in lines.values() if line) + "end_header\n"
    data = path.read_bytes().replace(b"end_header\n", trailer.encode(), 1)
    path.write_bytes(data + payload + bytes(-len(payload) % 4))
    return path


def entry(dtype: Any = "F32", shape: Any = (2,), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


BAD_PAYLOADS = {
    "empty": (b"", ["0 bytes"]),
    "shorter than its length": (b"\0" * 7, ["7 bytes"]),
    "header length lies": (safetensors_bytes({}, length=100), ["100 bytes", "at most 2"]),
    "header length of 2^64": (b"\xff" * 8 + b"{}", ["18446744073709551615 bytes", "at most 2"]),
    "header over the limit": (safetensors_bytes(b"{}" + b" " * MAX_HEADER_BYTES), ["1048578 bytes", "at most 1048576"]),
    "not JSON": (safetensors_bytes(b"{'a'}"), ["not valid JSON"]),
    "not UTF-8": (safetensors_bytes(b'{"\xff": 1}'), ["not valid JSON"]),
    "a pickle": (safetensors_bytes(b"cos\nsystem\n(S'true'\ntR."), ["not valid JSON"]),
    "nested": (safetensors_bytes(b"[" * 200_000), ["not valid JSON", "nested too deeply"]),
    "number of 10000 digits": (safetensors_bytes(b'{"a": ' + b"9" * 10_000 + b"}"), ["not valid JSON"]),
    "half a surrogate pair": (safetensors_bytes({"__metadata__": {"a": "\ud800"}}), ["not valid JSON"]),
    "name twice": (safetensors_bytes(b'{"a": 1, "a": 1}'), ["not valid JSON", "twice"]),
    "not a table": (safetensors_bytes([]), ["not a JSON table"]),
    "metadata no table": (safetensors_bytes({"__metadata__": [1]}), ["__metadata__"]),
    "metadata no texts": (safetensors_bytes({"__metadata__": {"a": 1}}), ["__metadata__"]),
    "entry no table": (safetensors_bytes({"a": 1}), ["'a'", "dtype, shape and data_offsets"]),
    "entry lacks its shape": (safetensors_bytes({"a": {"dtype": "F32", "data_offsets": [0, 0]}}), ["'a'", "shape"]),
    "unknown dtype": (safetensors_bytes({"a": entry("F99")}, bytes(8)), ["'a'", "unknown dtype 'F99'"]),
    "dtype no text": (safetensors_bytes({"a": entry(["F32"])}, bytes(8)), ["'a'", "unknown dtype"]),
    "object dtype": (safetensors_bytes({"a": entry("O", (1,))}, bytes(8)), ["'a'", "unknown dtype 'O'"]),
    "negative size": (safetensors_bytes({"a": entry(shape=(-2, -1))}, bytes(8)), ["'a'", "[-2, -1]"]),
    "size no integer": (safetensors_bytes({"a": entry(shape=(2.0,))}, bytes(8)), ["'a'", "[2.0]"]),
    "size a truth value": (safetensors_bytes({"a": entry(shape=(True, 2))}, bytes(8)), ["'a'", "[True, 2]"]),
    "nine axes": (safetensors_bytes({"a": entry(shape=(1,) * 8 + (2,))}, bytes(8)), ["'a'"]),
    "one offset": (safetensors_bytes({"a": entry(offsets=(0,))}, bytes(8)), ["'a'", "[0]"]),
    "offsets backwards": (safetensors_bytes({"a": entry(offsets=(8, 0))}, bytes(8)), ["'a'", "8 bytes", "-8"]),
    "shape against offsets": (safetensors_bytes({"a": entry(shape=(3,))}, bytes(8)), ["needs 12 bytes", "hold 8"]),
    "shape of 2^159": (safetensors_bytes({"a": entry(shape=(2**53 - 1,) * 3)}, bytes(8)), ["'a'", "hold 8"]),
    "empty and huge": (safetensors_bytes({"a": entry(shape=(0, 2**52, 2**52), offsets=(0, 0))}), ["'a'"]),
    "out of bounds": (safetensors_bytes({"a": entry()}, bytes(4)), ["end at byte 8", "at 4"]),
    "far out of bounds": (safetensors_bytes({"a": entry("U8", (2**50,), (0, 2**50))}), [str(2**50), "at 0"]),
    "bytes left over": (safetensors_bytes({"a": entry()}, bytes(12)), ["end at byte 8", "at 12"]),
    "overlap": (safetensors_bytes({"a": entry(), "b": entry(offsets=(4, 12))}, bytes(12)), ["'b'", "byte 4", "at 8"]),
    "gap": (safetensors_bytes({"a": entry(offsets=(4, 12))}, bytes(12)), ["'a'", "byte 4", "at 0"]),
    "NaN": (
        safetensors_bytes({"a": entry()}, np.array([1, np.nan], "<f4").tobytes()),
        ["'a'", "NaN", "1 of 2 values", "value 1"],
    ),
}
GOOD_PAYLOAD = safetensors_bytes({"a": entry()}, bytes(8))
BAD_ELEMENTS = {
    "no comment": ({"comment": ""}, ["comment lapgs4d v1 safetensors BYTES"]),
    "comment without a size": ({"comment": "comment lapgs4d v1 safetensors"}, ["safetensors BYTES"]),
    "size of 5000 digits": ({"comment": "comment lapgs4d v1 safetensors " + "9" * 5000}, ["safetensors BYTES"]),
    "pickle instead": ({"comment": "comment lapgs4d v1 pickle 9"}, ["safetensors BYTES"]),
    "newer version": ({"comment": "comment lapgs4d v2 safetensors 9"}, ["version 2", "reads version 1"]),
    "two properties": ({"property": "property ushort word\nproperty ushort more"}, ["uint word"]),
    "other type": ({"property": "property float word"}, ["uint word"]),
    "size too large": (
        {"comment": "comment lapgs4d v1 safetensors 1000"},
        ["1000 bytes", "20 words"],
    ),
    "size too small": ({"comment": "comment lapgs4d v1 safetensors 10"}, ["10 bytes", "words of 4 bytes"]),
    "count lies": ({"element": "element lapgs4d 2500000000"}, ["'lapgs4d'", "2500000000 rows of 4 bytes"]),
}


def assert_refused(path: Path, words: list[str], peak_limit: int) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            read_checkpoint(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 400
    assert not [word for word in words if word not in text], text
    assert peak < peak_limit


@pytest.mark.parametrize("name", BAD_PAYLOADS)
def test_bad_payload_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    payload, words = BAD_PAYLOADS[name]
    assert_refused(checkpoint_file(tmp_path, payload), ["lapgs4d", *words], 2**20)


@pytest.mark.parametrize("name", BAD_ELEMENTS)
def test_bad_element_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    changes, words = BAD_ELEMENTS[name]
    assert_refused(checkpoint_file(tmp_path, GOOD_PAYLOAD, **changes), words, 2**20)


def test_header_that_swells_in_memory(tmp_path: Path) -> None:
    """JSON takes many times its length once parsed; the limit on the header bounds that."""
    header = b'{"a": [' + b"[]," * 340_000 + b"[]]}"
    assert_refused(checkpoint_file(tmp_path, safetensors_bytes(header)), ["'a'"], 2**26)


def test_truncated_at_any_byte(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_checkpoint(path, STILL, TENSORS, METADATA)
    data = path.read_bytes()
    for size in [0, 3, 100, 1400, 1500, len(data) // 2, len(data) - 300, len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            read_checkpoint(path)


@pytest.mark.nightly
@given(st.data())
@settings(max_examples=400, deadline=None, derandomize=True)
def test_mutated_checkpoints_are_refused_or_valid(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Bytes changed anywhere in the safetensors part (in a file whose sizes agree), or anywhere in the whole file."""
    folder = tmp_path_factory.getbasetemp()
    payload = b"".join(pack_tensors(TENSORS, METADATA))
    if data.draw(st.booleans()):
        path = checkpoint_file(folder, mutate(payload, data))
    else:
        path = checkpoint_file(folder, payload)
        path.write_bytes(mutate(path.read_bytes(), data))
    try:
        still, tensors, metadata = read_checkpoint(path)
    except InputError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
    else:
        assert len(still) >= 1
        assert sum(array.nbytes for array in tensors.values()) <= path.stat().st_size
        assert all(np.isfinite(array).all() for array in tensors.values())
        assert all(isinstance(text, str) for text in metadata.values())


def test_what_cannot_be_stored_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_checkpoint(path, STILL, TENSORS, METADATA)
    before = path.read_bytes()
    with pytest.raises(
        InputError, match=r"a\.ply: not written, because tensor 'x' .* NaN or infinite in 1 of 2 values"
    ):
        write_checkpoint(path, STILL, {"x": np.array([0, np.inf])}, {})
    for array in [np.array([None]), np.array(["text"]), np.array([1j])]:
        with pytest.raises(ValueError, match=r"'x' of type .* cannot be stored"):
            write_checkpoint(path, STILL, {"x": array}, {})
    with pytest.raises(ValueError, match="cannot be stored"):
        write_checkpoint(path, STILL, {"__metadata__": np.zeros(3)}, {})
    with pytest.raises(ValueError, match="over the limit of 1048576"):
        write_checkpoint(path, STILL, {}, {"a": "b" * 2**20})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.ply"]


def test_full_disk_keeps_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    write_checkpoint(path, STILL, TENSORS, METADATA)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"not written \(No space left on device\)"):
        write_checkpoint(path, random_still(9), {}, {})
    monkeypatch.undo()
    assert_equal_tensors(read_checkpoint(path).tensors, TENSORS)
    assert os.listdir(tmp_path) == ["a.ply"]
