"""Captures of every layout, one of their files damaged at random: opened or refused in one sentence, and nothing else.

See test_hostile_files.py, which does the same to the other formats.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import WRITERS
from helpers.damaged_files import with_checksums
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

WORDS = [
    *(b"PINHOLE", b"OPENCV_FISHEYE", b" nan", b" inf", b" 1e308", b" 99999999999", b"#", b"\t", b" ../../x.png"),
    *(b"\xff" * 7, b"\0\0\0\0\0\0\xf8\x7f", b"\0\0\0\0\0\0\xf0\x7f", b"\0\0\0\0\0\0\0\x80"),
    *(b"'<f8'", b"'|O'", b"'<U9'", b"'|V9'", b"(4, 17)", b"(99999999999, 17)", b"(0, 17)", b"True", b"\x93NUMPY\3"),
    *(b"IHDR", b"IDAT", b"PLTE", b"tRNS", b"\0\0\xff\xff", b"moov", b"stsz", b"stts", b"avcC", b"mdat", b"hev1"),
]
# Files that are no JSON, and how many bytes of them declare sizes.
FILES = {
    "COLMAP binary": ("sparse/0/*.bin", 120),
    "COLMAP": ("sparse/0/*.txt", 120),
    "Neu3D": ("poses_bounds.npy", 130),
    "EndoNeRF": ("depth/000000.png", 60),
    "D-NeRF": ("train/*.png", 60),
    "Record3D": ("rgb/*.jpg", 60),
    "films": ("*.mp4", 1500),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("captures")


def capture_of(folder: Path, layout: str, device: Device) -> Path:
    """Written when it is first needed."""
    return folder / layout if (folder / layout).exists() else WRITERS[layout](folder / layout, device)


def opened(folder: Path, file: Path, damaged: bytes) -> None:
    """Open the capture, its first and last image, and a test image, while one file is damaged."""
    good = file.read_bytes()
    file.write_bytes(damaged)
    try:
        found = refused_or(lambda: load_dataset(folder))
        for view in (found.train[0], found.train[-1], found.test[0]) if found else ():
            refused_or(view.load)
            assert np.isfinite(view.camera.T_cam_world).all()
        if found and found.cloud is not None:
            assert np.isfinite(found.cloud.points).all()
    finally:
        file.write_bytes(good)


@fuzzed()
@given(st.integers(0, 2), byte_edits(WORDS), st.booleans())
@pytest.mark.parametrize("layout", FILES)
def test_bytes(folder: Path, device: Device, layout: str, number: int, edits: ByteEdits, other: bool) -> None:
    """Of sparse models, arrays, masks, depth maps, images and videos.

    other: checksums of a PNG that fit, so that the damage gets further in; damage at the end of a video.
    """
    files, head = FILES[layout]
    capture = capture_of(folder, layout, device)
    found = sorted(capture.glob(files))
    file = found[number % len(found)]
    data = file.read_bytes()
    damaged = edit_bytes(data, edits, head=head)
    if other and layout == "films":
        damaged = edit_bytes(data[::-1], edits, head=head)[::-1]
    elif other and file.suffix == ".png":
        damaged = with_checksums(damaged)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "unpacked"))
        opened(capture, file, damaged)
    shutil.rmtree(folder / "unpacked", ignore_errors=True)


@fuzzed()
@given(st.data(), tree_edits, byte_edits([b"[", b"{", b'"', b",", b":"], least=0).filter(lambda edits: len(edits) < 2))
@pytest.mark.parametrize("layout", ["D-NeRF", "nerfies", "nerfstudio", "Record3D", "Polycam"])
def test_descriptions(
    folder: Path, device: Device, layout: str, data: st.DataObject, changes: TreeEdits, edits: ByteEdits
) -> None:
    capture = capture_of(folder, layout, device)
    file = data.draw(st.sampled_from(sorted(capture.rglob("*.json"))))
    opened(capture, file, edit_bytes(json_text(edit_tree(json.loads(file.read_text()), changes)), edits))
