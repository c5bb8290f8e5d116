"""Captures of every layout, one of their files damaged at random: opened or refused in one sentence, and nothing else.

See test_hostile_files.py, which does the same to the other formats.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import write_colmap, write_nerfies, write_nerfstudio, write_neu3d
from helpers.external_captures import write_endonerf, write_polycam, write_record3d
from helpers.hostile import (
    ByteEdits,
    TreeEdits,
    byte_edits,
    edit_bytes,
    edit_tree,
    fuzzed,
    json_text,
    refused_or,
    tree_edits,
)
from hypothesis import given
from hypothesis import strategies as st

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu.device import Device

pytestmark = pytest.mark.nightly

MODEL = ("cameras", "images", "points3D")
WORDS = [
    *(b"PINHOLE", b"OPENCV_FISHEYE", b" nan", b" inf", b" 1e308", b" 99999999999", b"#", b"\t", b" ../../x.png"),
    *(b"\xff" * 7, b"\0\0\0\0\0\0\xf8\x7f", b"\0\0\0\0\0\0\xf0\x7f", b"\0\0\0\0\0\0\0\x80"),
]


@pytest.fixture(scope="module")
def captures(device: Device, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("captures")
    return {
        "bin": write_colmap(folder / "bin", device),
        "txt": write_colmap(folder / "txt", device, binary=False),
        "neu3d": write_neu3d(folder / "neu3d", device),
        "films": write_neu3d(folder / "films", device, count=3, video=True),
        "nerfies": write_nerfies(folder / "nerfies", device),
        "nerfstudio": write_nerfstudio(folder / "nerfstudio", device),
        "record3d": write_record3d(folder / "record3d", device),
        "polycam": write_polycam(folder / "polycam", device),
        "endonerf": write_endonerf(folder / "endonerf", device),
    }


def opened(folder: Path, file: Path, damaged: bytes) -> None:
    """Open the capture, its first and last picture, and a test picture with its mask, while one file is damaged."""
    good = file.read_bytes()
    file.write_bytes(damaged)
    try:
        found = refused_or(lambda: load_dataset(folder))
        for view in (found.train[0], found.train[-1], found.test[0]) if found else ():
            refused_or(view.load)
            refused_or(view.load_mask)
            assert np.isfinite(view.camera.T_cam_world).all()
        if found and found.cloud is not None:
            assert np.isfinite(found.cloud.points).all()
    finally:
        file.write_bytes(good)


@fuzzed()
@given(st.sampled_from(MODEL), byte_edits(WORDS))
@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_sparse_models(captures: dict[str, Path], suffix: str, name: str, edits: ByteEdits) -> None:
    file = captures[suffix] / "sparse/0" / f"{name}.{suffix}"
    opened(captures[suffix], file, edit_bytes(file.read_bytes(), edits, head=120))


@fuzzed()
@given(
    byte_edits(
        [b"'<f8'", b"'|O'", b"'<U9'", b"'|V9'", b"(4, 17)", b"(99999999999, 17)", b"(0, 17)", b"True", b"\x93NUMPY\3"]
    )
)
@pytest.mark.parametrize("layout", ["neu3d", "endonerf"])
def test_arrays(captures: dict[str, Path], layout: str, edits: ByteEdits) -> None:
    file = captures[layout] / "poses_bounds.npy"
    opened(captures[layout], file, edit_bytes(file.read_bytes(), edits, head=130))


@fuzzed()
@given(byte_edits([b"IHDR", b"IDAT", b"PLTE", b"tRNS", b"\0\0\xff\xff"]))
def test_masks(captures: dict[str, Path], edits: ByteEdits) -> None:
    file = captures["nerfies"] / "covisible/1x/val/left_000004.png"
    opened(captures["nerfies"], file, edit_bytes(file.read_bytes(), edits, head=60))


@fuzzed()
@given(byte_edits([b"IHDR", b"IDAT", b"PLTE", b"tRNS", b"\0\0\xff\xff"]))
def test_depth_maps(captures: dict[str, Path], edits: ByteEdits) -> None:
    file = captures["endonerf"] / "depth/000000.png"
    opened(captures["endonerf"], file, edit_bytes(file.read_bytes(), edits, head=60))


@fuzzed()
@given(byte_edits([b"moov", b"stsz", b"stts", b"avcC", b"mdat", b"hev1", b"vp09", b"\0\0\0\x01", b"\0\0\xff\xff"]))
def test_videos(captures: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, edits: ByteEdits) -> None:
    """What stands before the frames is at both ends of the file."""
    file = captures["films"] / "cam01.mp4"
    data = file.read_bytes()
    front = len(edits) % 2 == 0
    damaged = edit_bytes(data if front else data[::-1], edits, head=1500)
    unpacked = tmp_path_factory.getbasetemp() / "unpacked"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(unpacked))
        opened(captures["films"], file, damaged if front else damaged[::-1])
    shutil.rmtree(unpacked, ignore_errors=True)


@fuzzed()
@given(st.data(), tree_edits, byte_edits([b"[", b"{", b'"', b",", b":"], least=0).filter(lambda edits: len(edits) < 2))
@pytest.mark.parametrize("layout", ["nerfies", "nerfstudio", "record3d", "polycam"])
def test_descriptions(
    captures: dict[str, Path], layout: str, data: st.DataObject, changes: TreeEdits, edits: ByteEdits
) -> None:
    files = sorted(captures[layout].rglob("*.json"))
    file = data.draw(st.sampled_from(files))
    opened(captures[layout], file, edit_bytes(json_text(edit_tree(json.loads(file.read_text()), changes)), edits))
