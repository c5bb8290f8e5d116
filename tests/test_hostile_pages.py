"""The page's reader of compact scenes, in Chromium: the desktop's bits, and one sentence for every damaged file.

A few hundred files, always the same; LAPGS_FUZZ=10000 takes as many new ones (make soak).
"""

import base64
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import CHROMIUM, Browser
from helpers.damaged_files import compact, compact_scenes
from helpers.damaged_lapgs import CompactDamage, damage_compact, damaged_compact_scenes
from helpers.hostile import fuzzed
from helpers.scene_files import scene_of_outliers
from helpers.trained_scenes import OURS, trained
from hypothesis import given

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.lapgs_file import MAGIC
from lapgs_wgpu.motion.scene_file import compact_bytes, read_scene
from lapgs_wgpu.viewer.web_page import module_script

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]

READ = """(async text => {
    const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
    try {
        window.scene = await scene_js.readScene(bytes);
        return "";
    } catch (error) {
        return error instanceof refusal_js.Refusal ? error.message : `no sentence: ${error.stack}`;
    }
})"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("reader")
    (folder / "empty.html").write_text("<!doctype html><title>empty</title>")
    with Browser(folder / "profile", (64, 64)) as browser:
        browser.open((folder / "empty.html").as_uri())
        for name in ("refusal", "lapgs_file", "hash_grid", "scene"):
            browser.value(module_script(name) + "undefined")
        yield browser


def read(page: Browser, data: bytes) -> str:
    """What the page says of a file; nothing where it takes it."""
    said: str = page.value(f"{READ}('{base64.b64encode(data).decode()}')")
    return said


@pytest.mark.parametrize("still", [False, True], ids=["moving", "with outliers"])
def test_the_page_reads_the_same_bits(page: Browser, device: Device, tmp_path: Path, still: bool) -> None:
    data = (
        compact_bytes(scene_of_outliers(50), None)
        if still
        else compact(trained(device, OURS, 50), tmp_path / "a.ply", device)
    )
    (tmp_path / "a.lapgs").write_bytes(data)
    expected = read_scene(tmp_path / "a.lapgs")
    assert read(page, data) == ""
    arrays = {f"gaussians.{name}": values for name, values in expected.gaussians.items() if name != "sh_rest"}
    if not still:
        arrays["gaussians.sh_rest"] = expected.gaussians["sh_rest"][:, :8]  # of degree 2
    arrays |= {f"parameters['{name}']": values for name, values in expected.field.items()}
    for name, values in arrays.items():
        bits = page.value(f"Array.from(new Uint32Array(scene.{name}.buffer))")
        assert (np.array(bits, np.uint32) == np.ascontiguousarray(values).view(np.uint32).ravel()).all(), name


@pytest.fixture(scope="module")
def files(device: Device, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    return compact_scenes(tmp_path_factory.mktemp("compact"), device)


@fuzzed()
@given(damaged_compact_scenes(4))
def test_damaged_files(page: Browser, files: list[bytes], damage: CompactDamage) -> None:
    said = read(page, damage_compact(files, damage))
    assert not said.startswith("no sentence"), said
    assert said.isprintable()
    assert len(said) < 500


def test_a_later_version_and_a_foreign_file(page: Browser, files: list[bytes]) -> None:
    later = files[0][:8] + (3).to_bytes(4, "little") + files[0][12:]
    assert "version 3" in read(page, later)
    for data in (b"", b"ply\nformat", files[0][:100], files[0] + b"more"):
        assert "The scene cannot be read: " in read(page, data)


def test_files_that_unpack_to_too_much(page: Browser) -> None:
    """A small file cannot fill the memory of who opens it."""
    zeros = zlib.compress(bytes(2**26))
    for size in (2**26, 2**21, 1000, 2**30 + 1):
        said = read(page, struct.pack("<8sIQ", MAGIC, 1, size) + zeros)
        assert str(size) in said
        assert not said.startswith("no sentence"), said
