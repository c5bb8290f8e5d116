"""Files that desktops keep beside others."""

from pathlib import Path

import numpy as np
import pytest
from helpers.captures import WRITERS

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.listing import listed
from lapgs_wgpu.train.run_folder import check_run_folder


def scatter(folder: Path) -> None:
    """What macOS leaves on a drive of another system, and what its Finder and Windows' Explorer leave."""
    for file in [entry for entry in folder.rglob("*") if entry.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07")
    for each in [folder, *(entry for entry in folder.rglob("*") if entry.is_dir())]:
        for name in (".DS_Store", "desktop.ini", "Thumbs.db"):
            (each / name).write_bytes(b"\x00")


@pytest.mark.parametrize("layout", WRITERS)
def test_a_capture_is_read_without_them(layout: str, tmp_path: Path, device: Device) -> None:
    folder = WRITERS[layout](tmp_path / "capture", device)
    before = load_dataset(folder)
    scatter(folder)
    after = load_dataset(folder)
    assert after.warnings == before.warnings
    for split in ("train", "test", "val"):
        pairs = list(zip(getattr(before, split), getattr(after, split), strict=True))
        for one, other in pairs:
            assert (one.name, one.time, one.source) == (other.name, other.time, other.source)
            np.testing.assert_array_equal(one.camera.T_cam_world, other.camera.T_cam_world)


def test_a_run_folder_with_them_is_empty(tmp_path: Path) -> None:
    scatter(tmp_path)
    check_run_folder(tmp_path, overwrite=False)
    (tmp_path / "notes.txt").touch()
    assert [entry.name for entry in listed(tmp_path)] == ["notes.txt"]
