"""The checkpoint: its bytes, what it gives back, and what a hostile one cannot do."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from helpers.ply_files import INRIA, assert_same, random_still, read_ply, refused_within

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


def test_without_the_element_too_a_file_is_a_still_scene(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, {}, {})
    write_ply(tmp_path / "b.ply", STILL)
    for name in ("a.ply", "b.ply"):
        still, tensors, metadata = read_checkpoint(tmp_path / name)
        assert_same(still, STILL)
        assert (tensors, metadata) == ({}, {})


def test_the_safetensors_package_reads_what_is_written_and_is_read(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, TENSORS, METADATA)
    payload = payload_of(tmp_path / "a.ply")
    assert_equal_tensors(safetensors.numpy.load(payload), TENSORS)
    (tmp_path / "a.safetensors").write_bytes(payload)
    with safetensors.safe_open(tmp_path / "a.safetensors", "numpy") as file:
        assert file.metadata() == METADATA
    path = checkpoint_file(tmp_path, safetensors.numpy.save(TENSORS, METADATA))
    assert_equal_tensors(read_checkpoint(path).tensors, TENSORS)
    assert read_checkpoint(path).metadata == METADATA


def test_bytes_depend_on_the_content_alone(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.ply", STILL, TENSORS, METADATA)
    other = {name: array.astype(array.dtype.newbyteorder(">"), order="F") for name, array in reversed(TENSORS.items())}
    other["means"] = np.repeat(TENSORS["means"], 2, axis=1)[:, ::2]  # not contiguous
    write_checkpoint(tmp_path / "b.ply", STILL, other, dict(reversed(METADATA.items())))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


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


HOLE = np.array([1, np.nan], "<f4").tobytes()
# The safetensors bytes, and what the error must name.
BAD_PAYLOADS: list[tuple[bytes, str]] = [
    (b"", "0 bytes"),
    (b"\0" * 7, "7 bytes"),
    (safetensors_bytes({}, length=100), "100 bytes"),
    (b"\xff" * 8 + b"{}", "18446744073709551615 bytes"),
    (safetensors_bytes(b"{}" + b" " * MAX_HEADER_BYTES), "1048578 bytes"),
    *((safetensors_bytes(text), "JSON") for text in
      (b"{'a'}", b'{"\xff": 1}', b"cos\nsystem\n(S'true'\ntR.", b"[" * 200_000, b'{"a": ' + b"9" * 10_000 + b"}")),
    (safetensors_bytes({"__metadata__": {"a": "\ud800"}}), "JSON"),
    (safetensors_bytes(b'{"a": 1, "a": 1}'), "twice"),
    (safetensors_bytes([]), "table"),
    (safetensors_bytes({"__metadata__": [1]}), "__metadata__"),
    (safetensors_bytes({"__metadata__": {"a": 1}}), "__metadata__"),
    (safetensors_bytes({"a": 1}), "'a'"),
    (safetensors_bytes({"a": {"dtype": "F32", "data_offsets": [0, 0]}}), "shape"),
    *((safetensors_bytes({"a": entry(kind)}, bytes(8)), "dtype") for kind in ("F99", ["F32"], "O")),
    *((safetensors_bytes({"a": entry(shape=shape)}, bytes(8)), "'a'") for shape in
      ((-2, -1), (2.0,), (True, 2), (1,) * 8 + (2,), (3,), (2**53 - 1,) * 3)),
    *((safetensors_bytes({"a": entry(offsets=offsets)}, bytes(8)), "'a'") for offsets in ((0,), (8, 0))),
    (safetensors_bytes({"a": entry(shape=(0, 2**52, 2**52), offsets=(0, 0))}), "'a'"),
    (safetensors_bytes({"a": entry()}, bytes(4)), "byte 8"),
    (safetensors_bytes({"a": entry("U8", (2**50,), (0, 2**50))}), str(2**50)),
    (safetensors_bytes({"a": entry()}, bytes(12)), "12"),
    (safetensors_bytes({"a": entry(), "b": entry(offsets=(4, 12))}, bytes(12)), "'b'"),
    (safetensors_bytes({"a": entry(offsets=(4, 12))}, bytes(12)), "'a'"),
    (safetensors_bytes({"a": entry()}, HOLE), "'a'"),
]  # fmt: skip
GOOD_PAYLOAD = safetensors_bytes({"a": entry()}, bytes(8))
SAID = "comment lapgs4d v1 safetensors"
# Other lines of the element, and what the error must name.
BAD_ELEMENTS: list[tuple[dict[str, str], str]] = [
    ({"comment": ""}, "comment"),
    ({"comment": SAID}, "safetensors BYTES"),
    ({"comment": f"{SAID} {'9' * 5000}"}, "safetensors BYTES"),
    ({"comment": "comment lapgs4d v1 pickle 9"}, "safetensors BYTES"),
    ({"comment": "comment lapgs4d v2 safetensors 9"}, "version 2"),
    ({"comment": f"{SAID} 1000"}, "1000 bytes"),
    ({"comment": f"{SAID} 10"}, "10 bytes"),
    ({"property": "property ushort word\nproperty ushort more"}, "uint word"),
    ({"property": "property float word"}, "uint word"),
    ({"element": "element lapgs4d 2500000000"}, "2500000000"),
]


@pytest.mark.parametrize("number", range(len(BAD_PAYLOADS)))
def test_a_bad_payload_is_refused(tmp_path: Path, number: int) -> None:
    payload, named = BAD_PAYLOADS[number]
    refused_within(checkpoint_file(tmp_path, payload), named, 2**20)


@pytest.mark.parametrize("number", range(len(BAD_ELEMENTS)))
def test_a_bad_element_is_refused(tmp_path: Path, number: int) -> None:
    changes, named = BAD_ELEMENTS[number]
    refused_within(checkpoint_file(tmp_path, GOOD_PAYLOAD, **changes), named, 2**20)


def test_truncated_at_any_byte(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_checkpoint(path, STILL, TENSORS, METADATA)
    data = path.read_bytes()
    for size in [0, 3, 100, 1400, 1500, len(data) // 2, len(data) - 300, len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            read_checkpoint(path)


def test_what_cannot_be_stored_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_checkpoint(path, STILL, TENSORS, METADATA)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"a\.ply: .* tensor 'x'"):
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
