"""The notes of a release: tag, version and changelog must agree (.ci/release_notes.py)."""

from __future__ import annotations

import importlib.util
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
spec = importlib.util.spec_from_file_location("release_notes", ROOT / ".ci" / "release_notes.py")
assert spec is not None
assert spec.loader is not None
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

CHANGELOG = "# Changelog\n\n## 0.2.0, 2030-01-31\n- New.\n- More.\n\n## 0.1.0, unreleased\n- Old.\n"


def test_notes_are_the_section_of_the_tag() -> None:
    assert module.release_notes("v0.2.0", "0.2.0", CHANGELOG) == "- New.\n- More.\n"


@pytest.mark.parametrize(
    ("tag", "version", "message"),
    [
        ("v0.2.1", "0.2.0", "the tag must be v0.2.0"),
        ("v0.3.0", "0.3.0", "no section 0.3.0"),
        ("v0.1.0", "0.1.0", 'needs "0.1.0, YYYY-MM-DD"'),
    ],
)
def test_disagreement_makes_no_release(tag: str, version: str, message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        module.release_notes(tag, version, CHANGELOG)


def test_the_changelog_has_the_current_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    titles = [line for line in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines() if line[:3] == "## "]
    assert titles[0].startswith(f"## {project['version']}, ")
