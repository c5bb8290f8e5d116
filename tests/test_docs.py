"""The documents: Python in them runs as it stands, links and anchors lead somewhere, commands name options, goals and
files that are there, and those that take a moment are run."""

from __future__ import annotations

import contextlib
import functools
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lapgs_wgpu import Scene4D
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
EXAMPLES = [
    example
    for file in ("README.md", "docs/training.md")
    for example in re.findall(r"```python\n(.*?)```", (ROOT / file).read_text(encoding="utf-8"), re.S)
]


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


def anchors(file: Path) -> set[str]:
    """Of the headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("file", DOCUMENTS, ids=lambda file: str(file.relative_to(ROOT)))
def test_links_lead_somewhere(file: Path) -> None:
    for link in re.findall(r"\]\((?!https?://)([^) ]+)\)", file.read_text(encoding="utf-8")):
        path, _, anchor = link.partition("#")
        target = file.parent / path if path else file
        assert target.is_file(), link
        if anchor:
            assert anchor in anchors(target), link


PROGRAMS = {
    "lapgs-train": "lapgs_wgpu.cli",
    "lapgs-table": "lapgs_wgpu.table_cli",
    "lapgs-prepare": "lapgs_wgpu.prepare_cli",
    "lapgs-doctor": "lapgs_wgpu.doctor_cli",
    "lapgs-view": "lapgs_wgpu.viewer.cli",
}


def commands() -> list[tuple[str, list[str]]]:
    """Every command line of the documents: file and words."""
    found = []
    for file in DOCUMENTS:
        for block in re.findall(r"^```(?:sh|bash)?\n(.*?)^```", file.read_text(encoding="utf-8"), re.S | re.M):
            for line in block.replace("\\\n", " ").splitlines():
                with contextlib.suppress(ValueError):  # a quotation mark that is no shell's
                    words = shlex.split(line, comments=True)
                    for part in " ".join(words).split(" && "):
                        found.append((file.name, part.split()))
    return [(file, words) for file, words in found if words]


@functools.cache
def help_of(program: str) -> str:
    command = [sys.executable, "-c", f"from {PROGRAMS[program]} import *; {FUNCTIONS[program]}(['--help'])"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


FUNCTIONS = {name: f"{name.removeprefix('lapgs-')}_command" for name in PROGRAMS}


def test_commands_name_options_that_exist() -> None:
    seen = set()
    for file, words in commands():
        program = words[0].rpartition("/")[2]
        if program not in PROGRAMS:
            continue
        seen.add(program)
        for option in (word.split("=")[0] for word in words if word.startswith("--")):
            assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", help_of(program)), f"{file}: {' '.join(words)}"
    assert seen == set(PROGRAMS)


def test_commands_name_goals_and_files_that_exist() -> None:
    goals = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for file, words in commands():
        if words[0] == "make":
            assert {word for word in words[1:2] if "=" not in word} <= goals, f"{file}: {' '.join(words)}"
        for word in words:
            if (
                re.fullmatch(r"(docs/tables|benchmarks|examples|tests|configs|\.ci)/[\w./-]+", word)
                and "NAME" not in word
            ):
                assert (ROOT / word).exists(), f"{file}: {word}"


@pytest.mark.usefixtures("demo")
def test_commands_that_take_a_moment_run() -> None:
    """Those of the viewer on the demo's checkpoint that open no window."""
    from lapgs_wgpu.viewer.cli import view_command

    done = 0
    for file, words in commands():
        if words[0] == ".venv/bin/lapgs-view" and words[1] == "runs/demo/checkpoint.ply":
            if not {"--screenshot", "--export"} & set(words):
                continue
            assert view_command([*words[1:], *(["--overwrite"] if "--export" in words else [])]) == 0, (
                f"{file}: {words}"
            )
            done += 1
    assert done >= 2


def test_the_list_of_passes_names_every_shader() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    shaders = {file.stem for file in (ROOT / "shaders").glob("*.wgsl")}
    assert shaders <= set(re.findall(r"`(\w+)`", text))
