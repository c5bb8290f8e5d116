"""The .ply reader and writer: the layout byte for byte, other programs' variants, and files that lie."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext
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
    mutate,
    ply_bytes,
    random_still,
    read_ply,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.ply import GaussianSnapshot, write_ply

REAL_FILES = Path(__file__).parents[2] / "shared" / "data" / "ply"


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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 5000])  # 5000 rows are read in several blocks
def test_round_trip_pads_sh_to_degree_3(tmp_path: Path, degree: int, n: int) -> None:
    still = random_still(n, degree)
    write_ply(tmp_path / "a.ply", still)
    back = read_ply(tmp_path / "a.ply")
    k = still.sh.shape[1]
    padded = np.zeros((n, 16, 3), np.float32)
    padded[:, :k] = still.sh
    assert_same(back, GaussianSnapshot(still.means, padded, still.opacity_logits, still.log_scales, still.quats))
    assert back.sh_degree == 3
    assert len(back) == n
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


ROW = 4 * 23  # x y z, 3 + 9 colors, opacity, 3 scales, 4 of rotation
BAD = {
    "empty": (b"", ["empty", "0 bytes"]),
    "not a PLY": (b"\x89PNG\r\n\x1a\n" + bytes(100), ["begins with", "PNG"]),
    "plymouth": (b"plymouth\n", ["begins with"]),
    "unknown encoding": (edit(b"binary_little_endian", b"binary"), ["line 2", "'format binary 1.0'"]),
    "no format": (edit(b"format binary_little_endian 1.0\n", b""), ["no line 'format"]),
    "header cut off": (GOOD[:200], ["end_header", "200 bytes"]),
    "header too long": (edit(b"element", b"comment " + b"a" * 70000 + b"\nelement"), ["end_header", "65536"]),
    "nonsense line": (edit(b"property float z", b"floats z"), ["line 6", "'floats z'"]),
    "empty line": (edit(b"property float z", b""), ["line 6"]),
    "list property": (edit(b"property float z", b"property list uchar int z"), ["vertex", "list"]),
    "unknown type": (edit(b"property float z", b"property half z"), ["line 6", "'half'"]),
    "object type": (edit(b"property float z", b"property O z"), ["line 6", "'O'"]),
    "property twice": (edit(b"property float z", b"property float y"), ["line 6", "second time"]),
    "element twice": (edit(b"end_header", b"element vertex 4\nend_header"), ["element", "second time"]),
    "property first": (edit(b"element vertex 4\n", b""), ["line 3", "before any element"]),
    "no vertex": (edit(b"element vertex", b"element vortex"), ["no element vertex"]),
    "negative count": (edit(b"vertex 4", b"vertex -4"), ["vertex -4", "count"]),
    "count not a number": (edit(b"vertex 4", b"vertex 1_0"), ["vertex 1_0", "count"]),
    "count of 5000 digits": (edit(b"vertex 4", b"vertex " + b"9" * 5000), ["count"]),
    "zero Gaussians": (GOOD[:SPLIT].replace(b"vertex 4", b"vertex 0") + b"end_header\n", ["0 Gaussians"]),
    "10 GB by its header": (edit(b"vertex 4", b"vertex 100000000"), ["100000000 rows of 92", f"{len(GOOD) + 8} bytes"]),
    "count over memory": (edit(b"vertex 4", b"vertex 999999999999999999"), ["9999999 rows", f"{len(GOOD) + 17} bytes"]),
    "truncated": (GOOD[:-1], [str(len(GOOD)), str(len(GOOD) - 1)]),
    "one row short": (GOOD[:-ROW], [str(len(GOOD)), str(len(GOOD) - ROW)]),
    "trailing bytes": (GOOD + b"\n\n", [str(len(GOOD)), str(len(GOOD) + 2), "appended"]),
    "count too low": (edit(b"vertex 4", b"vertex 3"), [str(len(GOOD)), str(len(GOOD) - ROW)]),
    "second element lies": (edit(b"end_header", b"element e 9\nproperty int a\nend_header"), ["'e'", "9 rows of 4"]),
    "a property missing": (edit(b"scale_1", b"scale_9"), ["lacks", "scale_1"]),
    "Gaussians that move": (edit(b"property float opacity", b"property float trbf_center"), ["trbf_center"]),
    "many missing": (ply_bytes({"x": ("float", np.zeros(2))}), ["lacks", "y, z, f_dc_0", "more", "1 properties"]),
    "SH of no degree": (edit(b"f_rest_8", b"e_rest_8"), ["8 properties f_rest_*", "9, 24 or 45"]),
    "SH not numbered on": (edit(b"f_rest_8", b"f_rest_9"), ["lacks", "f_rest_8"]),
    "PlayCanvas compressed": (
        ply_bytes({f"packed_{name}": ("uint", [0, 0]) for name in ["position", "rotation", "scale", "color"]}),
        ["PlayCanvas", "packed_position", "convert"],
    ),
    "NaN": (with_value("f_rest_3", np.nan, (1, 3)), ["f_rest_3", "NaN", "2 of 4 rows", "row 1"]),
    "Inf": (with_value("x", -np.inf), ["property x", "1 of 4 rows", "row 2"]),
    "scale overflows": (with_value("scale_1", 45.0), ["scale_1", "44", "row 2"]),
    "double beyond float32": (
        ply_bytes(columns_of(random_still(4, 0)) | {"f_dc_0": ("double", np.full(4, 1e300))}),
        ["f_dc_0", "4 of 4 rows"],
    ),
    "nothing visible": (with_value("opacity", -np.inf, (0, 1, 2, 3)), ["opacity"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_file_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    data, words = BAD[name]
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            read_ply(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 300
    assert not [word for word in words if word not in text], text
    assert peak < 2**20  # nothing is allocated on the word of a header


def test_paths_that_are_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    for path, word in {
        tmp_path / "missing.ply": "No such file",
        tmp_path: "folder",
        tmp_path / "pipe.ply": "not a regular file",
        Path("/dev/zero"): "not a regular file",
        tmp_path / "loop.ply": "symbolic links",
    }.items():
        with pytest.raises(InputError, match=word) as error:
            read_ply(path)
        assert str(error.value).startswith(f"{path}: ")


def test_file_that_shrinks_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, random_still(5000))
    real = np.fromfile

    def shrink(file, dtype, count):  # type: ignore[no-untyped-def]
        os.truncate(path, 600_000)
        return real(file, dtype, count)

    monkeypatch.setattr(np, "fromfile", shrink)
    with pytest.raises(InputError, match=r"became shorter while it was read, at row \d+ of 5000"):
        read_ply(path)


@pytest.mark.nightly
@given(st.data())
@settings(max_examples=400, deadline=None, derandomize=True)
def test_mutated_files_are_refused_or_valid(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.ply"
    path.write_bytes(mutate(GOOD, data))
    try:
        still = read_ply(path)
    except InputError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
    else:
        assert len(still) >= 1
        assert all(np.isfinite(getattr(still, name)).all() for name in FIELDS)


def test_values_that_could_not_be_read_back_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, random_still(2))
    before = path.read_bytes()
    still = random_still(3)
    still.log_scales[1, 2] = np.nan
    with pytest.raises(InputError, match="not written, because property scale_2 is NaN or infinite in 1 of 3 rows"):
        write_ply(path, still)
    with pytest.raises(InputError, match="0 Gaussians"):
        write_ply(path, random_still(0))
    assert path.read_bytes() == before


def test_arrays_of_wrong_shape_or_type_are_refused() -> None:
    a = random_still(3)
    with pytest.raises(ValueError, match="quats is float32"):
        GaussianSnapshot(a.means, a.sh, a.opacity_logits, a.log_scales, a.quats[:2])
    with pytest.raises(ValueError, match="means is float64"):
        GaussianSnapshot(a.means.astype(float), a.sh, a.opacity_logits, a.log_scales, a.quats)
    with pytest.raises(ValueError, match="K of 1, 4, 9 or 16"):
        GaussianSnapshot(a.means, a.sh[:, :5], a.opacity_logits, a.log_scales, a.quats)


# Atomic writing: each fault is injected at one step, and the old file must be whole and alone in its folder.


def fail_with(code: int) -> Callable[..., None]:
    def fail(*args: object, **kwargs: object) -> None:
        raise OSError(code, os.strerror(code))

    return fail


@pytest.mark.parametrize(
    ("step", "code"),
    [("fsync", errno.ENOSPC), ("fsync", errno.EIO), ("replace", errno.EACCES), ("replace", errno.EROFS)],
)
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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_full_disk_while_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, random_still(2))
    before = path.read_bytes()
    real = open
    monkeypatch.setattr(
        "builtins.open", lambda name, mode: real("/dev/full", "wb") if mode == "xb" else real(name, mode)
    )
    with pytest.raises(InputError, match="No space left on device"):
        write_ply(path, random_still(20_000))
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


@pytest.mark.parametrize(
    ("winerror", "failures", "moved"), [(5, 3, True), (32, 1, True), (32, 99, False), (80, 1, False)]
)
def test_a_file_that_another_program_holds_for_moments(
    winerror: int, failures: int, moved: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Windows' virus scanners do."""
    real, waits = os.replace, []

    def held(source: Path, target: Path) -> None:
        if len(waits) < failures:
            error = PermissionError(errno.EACCES, "Access is denied")
            error.winerror = winerror
            raise error
        real(source, target)

    monkeypatch.setattr(os, "replace", held)
    monkeypatch.setattr(time, "sleep", waits.append)
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with nullcontext() if moved else pytest.raises(InputError, match="Access is denied"), atomic_write(path) as file:
        file.write(b"new")
    assert path.read_bytes() == (b"new" if moved else b"old")
    assert len(waits) == (failures if moved else 0 if winerror == 80 else 6)
    assert os.listdir(tmp_path) == ["a"]


def test_folders_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.ply").mkdir()
    for path in [
        tmp_path / "missing" / "a.ply",
        tmp_path / "file" / "a.ply",
        tmp_path / "folder.ply",
        Path("/proc/a.ply"),
    ]:
        with pytest.raises(InputError, match="not written") as error:
            write_ply(path, random_still(2))
        assert str(error.value).startswith(f"{path}: ")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.ply"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write to read-only folders")
def test_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        write_ply(tmp_path / "a.ply", random_still(2))
    tmp_path.chmod(0o700)


def test_interrupted_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as file:  # noqa: PT012
        file.write(b"new")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


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


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    old = os.umask(0o027)
    try:
        write_ply(tmp_path / "a.ply", random_still(2))
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "a.ply").stat().st_mode) == 0o640


@pytest.mark.parametrize("step", ["os.fsync", "os.replace"])
def test_killed_while_writing_keeps_the_old_file(tmp_path: Path, step: str) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    program = f"""
import os, signal
from lapgs_wgpu.io.atomic import atomic_write
{step} = lambda *args: os.kill(os.getpid(), signal.SIGKILL)
with atomic_write({str(path)!r}) as file:
    file.write(b"new")
"""
    assert subprocess.run([sys.executable, "-c", program]).returncode == -9
    assert path.read_bytes() == b"old"


# Files of other programs.


@pytest.mark.skipif(not REAL_FILES.is_dir(), reason="the real files are not part of the project")
@pytest.mark.parametrize(
    ("name", "n"),
    [("mkkellogg_lod1_14051", 14051), ("supersplat_fruit_drops_4721", 4721), ("4dgs_coarse_iter99_2000", 2000)],
)
def test_reads_files_of_other_programs(tmp_path: Path, name: str, n: int) -> None:
    still = read_ply(REAL_FILES / f"{name}.ply")
    assert still.means.shape == (n, 3)
    assert still.sh.shape == (n, 16, 3)
    write_ply(tmp_path / "a.ply", still)
    assert_same(read_ply(tmp_path / "a.ply"), still)
    if "4dgs" in name:  # Inria's own writer: the same bytes
        assert (tmp_path / "a.ply").read_bytes() == (REAL_FILES / f"{name}.ply").read_bytes()


@pytest.mark.skipif(not REAL_FILES.is_dir(), reason="the real files are not part of the project")
def test_refuses_playcanvas_compressed() -> None:
    with pytest.raises(InputError, match="PlayCanvas's compressed layout"):
        read_ply(REAL_FILES / "playcanvas_guitar.compressed.ply")
