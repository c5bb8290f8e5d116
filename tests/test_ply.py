"""The .ply reader and writer: the layout byte for byte, other programs' variants, and files that lie."""

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.ply_files import (
    FIELDS,
    GOOD,
    INRIA,
    SPLIT,
    assert_same,
    columns_of,
    ply_bytes,
    random_still,
    read_ply,
    refused_within,
)

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.ply import GaussianSnapshot, write_ply


def test_written_bytes_are_inrias_layout(tmp_path: Path) -> None:
    still = random_still(7, degree=3)
    write_ply(tmp_path / "a.ply", still)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert lines[3:] == [f"property float {name}" for name in INRIA]
    rows = np.frombuffer(body, "<f4").reshape(7, 62)
    column = {name: rows[:, i] for i, name in enumerate(INRIA)}
    np.testing.assert_array_equal(column["y"], still.means[:, 1])
    np.testing.assert_array_equal(column["nz"], 0)
    np.testing.assert_array_equal(column["f_dc_2"], still.sh[:, 0, 2])
    np.testing.assert_array_equal(column["f_rest_0"], still.sh[:, 1, 0])  # red, first coefficient of degree 1
    np.testing.assert_array_equal(column["f_rest_14"], still.sh[:, 15, 0])  # red, last
    np.testing.assert_array_equal(column["f_rest_15"], still.sh[:, 1, 1])  # green, first
    np.testing.assert_array_equal(column["f_rest_44"], still.sh[:, 15, 2])  # blue, last
    np.testing.assert_array_equal(column["opacity"], still.opacity_logits)
    np.testing.assert_array_equal(column["scale_2"], still.log_scales[:, 2])
    np.testing.assert_array_equal(column["rot_0"], still.quats[:, 0])  # w


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (1, 2), (5000, 1), (5000, 3)])
def test_round_trip_pads_sh_to_degree_3(tmp_path: Path, degree: int, n: int) -> None:
    still = random_still(n, degree)
    write_ply(tmp_path / "a.ply", still)
    back = read_ply(tmp_path / "a.ply")
    k = still.sh.shape[1]
    padded = np.zeros((n, 16, 3), np.float32)
    padded[:, :k] = still.sh
    assert_same(back, GaussianSnapshot(still.means, padded, still.opacity_logits, still.log_scales, still.quats))
    assert (back.sh_degree, len(back)) == (3, n)
    assert all(getattr(back, name).flags.c_contiguous for name in FIELDS)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reads_any_order_degree_and_further_properties(tmp_path: Path, degree: int) -> None:
    still = random_still(6, degree)
    columns = columns_of(still)
    extra = {
        "red": ("uchar", np.arange(6)), "weight": ("double", np.full(6, np.nan)), "label": ("short", np.arange(6)),
        "f_distance": ("int", np.arange(6)),
    }  # fmt: skip
    names = list(columns | extra)
    np.random.default_rng(degree).shuffle(names)
    columns["x"] = ("double", columns["x"][1])
    columns["rot_3"] = ("float32", columns["rot_3"][1])
    (tmp_path / "a.ply").write_bytes(ply_bytes({name: (columns | extra)[name] for name in names}))
    assert_same(read_ply(tmp_path / "a.ply"), still)


def test_reads_comments_crlf_and_other_elements(tmp_path: Path) -> None:
    still = random_still(3, 0)
    data = ply_bytes(columns_of(still))
    header, _, body = data.partition(b"end_header\n")
    header = header.replace(b"element vertex", b"comment \xc3\xa9\nelement camera 2\nproperty uchar a\nelement vertex")
    header = header.replace(b"ply\n", b"ply\nobj_info b\n", 1) + b"element tail 1\nproperty double t\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header.replace(b"\n", b"\r\n") + b"\n\n" + body + bytes(8))
    assert_same(read_ply(tmp_path / "a.ply"), still)


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_reads_text_and_big_endian_before_a_list(tmp_path: Path, encoding: str) -> None:
    still = random_still(3, 1)
    columns = columns_of(still)
    rows = np.stack([values for _, values in columns.values()], axis=1)
    header = ply_bytes(columns).partition(b"end_header")[0].replace(b"binary_little_endian", encoding.encode())
    header = header.replace(b"element", b"comment \xd6\xd0 in GBK\nelement pose 1\nproperty int a\nelement", 1)
    lines = "7\n" + "".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows)
    body = lines.encode() if encoding == "ascii" else bytes(4) + rows.astype(">f4").tobytes()
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header + faces + body + b"3 0 1 2\n")
    assert_same(read_ply(tmp_path / "a.ply"), still)


def edit(old: bytes, new: bytes) -> bytes:
    assert old in GOOD
    return GOOD.replace(old, new, 1)


def with_value(name: str, value: float, rows: tuple[int, ...] = (2,)) -> bytes:
    columns = columns_of(random_still(4, 1))
    for row in rows:
        columns[name][1][row] = value
    return ply_bytes(columns)


PACKED = {f"packed_{name}": ("uint", [0, 0]) for name in ["position", "rotation", "scale", "color"]}
# A file, and what the error must name.
BAD: list[tuple[bytes, str]] = [
    (b"", "0 bytes"),
    (b"\x89PNG\r\n\x1a\n" + bytes(100), "PNG"),
    (b"plymouth\n", "plymouth"),
    (edit(b"binary_little_endian", b"binary"), "format binary 1.0"),
    (edit(b"format binary_little_endian 1.0\n", b""), "format"),
    (GOOD[:200], "end_header"),
    (edit(b"element", b"comment " + b"a" * 70000 + b"\nelement"), "end_header"),
    (edit(b"property float z", b"floats z"), "floats z"),
    (edit(b"property float z", b""), "line 6"),
    (edit(b"property float z", b"property list uchar int z"), "list"),
    (edit(b"property float z", b"property quarter z"), "quarter"),
    (edit(b"property float z", b"property O z"), "property O z"),
    (edit(b"property float z", b"property float y"), "line 6"),
    (edit(b"end_header", b"element vertex 4\nend_header"), "element"),
    (edit(b"element vertex 4\n", b""), "line 3"),
    (edit(b"element vertex", b"element vortex"), "vertex"),
    (ply_bytes({name: ("float", [0, 0]) for name in "xyz"}), "cloud of points"),
    (edit(b"vertex 4", b"vertex 1_0"), "vertex 1_0"),
    (edit(b"vertex 4", b"vertex " + b"9" * 5000), "count"),
    (edit(b"vertex 4", b"vertex 100000000"), "100000000"),
    (edit(b"vertex 4", b"vertex 999999999999999999"), "9999999"),
    (edit(b"vertex 4", b"vertex 3"), str(len(GOOD))),
    (GOOD[:SPLIT].replace(b"vertex 4", b"vertex 0") + b"end_header\n", "0 Gaussians"),
    (GOOD[:-1], str(len(GOOD) - 1)),
    (GOOD + b"\n\n", str(len(GOOD) + 2)),
    (edit(b"end_header", b"element e 9\nproperty int a\nend_header"), "'e'"),
    (edit(b"scale_1", b"scale_9"), "scale_1"),
    (edit(b"f_rest_8", b"e_rest_8"), "f_rest_"),
    (edit(b"f_rest_8", b"f_rest_9"), "f_rest_8"),
    (ply_bytes(PACKED), "PlayCanvas"),
    (with_value("f_rest_3", np.nan, (1, 3)), "f_rest_3"),
    (with_value("x", -np.inf), "property x"),
    (with_value("scale_1", 45.0), "scale_1"),
    (ply_bytes(columns_of(random_still(4, 0)) | {"f_dc_0": ("double", np.full(4, 1e300))}), "f_dc_0"),
    (edit(b"property float opacity", b"property float trbf_center"), "trbf_center"),
    (with_value("opacity", -np.inf, (0, 1, 2, 3)), "opacity"),
]


@pytest.mark.parametrize("number", range(len(BAD)))
def test_a_bad_file_is_refused(tmp_path: Path, number: int) -> None:
    """And nothing is allocated on the word of a header."""
    data, named = BAD[number]
    (tmp_path / "bad.ply").write_bytes(data)
    refused_within(tmp_path / "bad.ply", named, 2**20)


def test_paths_that_are_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    for path in (tmp_path / "missing.ply", tmp_path, tmp_path / "pipe.ply", tmp_path / "loop.ply", Path("/dev/zero")):
        refused_within(path, "", 2**20)


def test_values_that_could_not_be_read_back_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, random_still(2))
    before = path.read_bytes()
    still = random_still(3)
    still.log_scales[1, 2] = np.nan
    with pytest.raises(InputError, match="scale_2"):
        write_ply(path, still)
    with pytest.raises(InputError, match="0 Gaussians"):
        write_ply(path, random_still(0))
    assert path.read_bytes() == before


# Atomic writing: each fault is injected at one step, and the old file must be whole and alone in its folder.


def fail_with(code: int) -> Callable[..., None]:
    def fail(*args: object, **kwargs: object) -> None:
        raise OSError(code, os.strerror(code))

    return fail


@pytest.mark.parametrize(("step", "code"), [("fsync", errno.ENOSPC), ("replace", errno.EROFS)])
def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, code: int) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, random_still(2))
    before = path.read_bytes()
    monkeypatch.setattr(os, step, fail_with(code))
    with pytest.raises(InputError, match=f"not written \\({os.strerror(code)}\\)") as error:
        write_ply(path, random_still(3))
    assert str(path) in str(error.value)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.ply"]


def test_folder_that_cannot_be_forced_to_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """File systems of networks and of virtual machines force none; the file is written."""
    real = os.fsync

    def refuse_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", refuse_folders)
    write_ply(tmp_path / "a.ply", random_still(2))
    assert_same(read_ply(tmp_path / "a.ply"), random_still(2))


def test_written_file_is_forced_to_the_disk_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = []
    fsync, replace = os.fsync, os.replace

    def record_fsync(descriptor: int) -> None:
        state = os.fstat(descriptor)
        steps.append("fsync folder" if stat.S_ISDIR(state.st_mode) else f"fsync {state.st_size} bytes")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", record_fsync)
    monkeypatch.setattr(os, "replace", lambda *names: (steps.append("replace"), replace(*names)))
    with atomic_write(tmp_path / "a") as file:
        file.write(b"12345")
    assert steps == ["fsync 5 bytes", "replace", "fsync folder"]
