"""The documents: the README's Python runs as it stands, links lead somewhere, the list of passes is whole."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from lapgs_wgpu import Scene4D
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.S)


@pytest.fixture
def demo(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in which `make demo` might have run."""
    grid = HashConfig(2, (4, 4, 4), (8, 8, 8), 10)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    config = FieldConfig(static=grid, temporal=grid, width=8)
    scene = Scene4D.from_points(points, np.full((50, 3), 0.5), np.full(50, 0.1), config, device=device)
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    scene.save(tmp_path / "runs" / "demo" / "checkpoint.ply")
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("demo")
@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_example(example: str) -> None:
    names: dict = {}
    exec(example, names)
    assert ("picture" in names) != ("image" in names)
    assert names["picture" if "picture" in names else "image"].shape == (240, 320, 3)


@pytest.mark.parametrize(
    "file", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda file: file.name
)
def test_linked_files_exist(file: Path) -> None:
    for link in re.findall(r"\]\((?!https?://)([^)#]+)\)", file.read_text(encoding="utf-8")):
        assert (file.parent / link).is_file(), link


def test_the_list_of_passes_names_every_shader() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    shaders = {file.stem for file in (ROOT / "shaders").glob("*.wgsl")}
    assert shaders <= set(re.findall(r"`(\w+)`", text))
