"""The notes of a release: tag, version and changelog must agree (.ci/release_notes.py)."""

import runpy
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
release_notes = runpy.run_path(str(ROOT / ".ci" / "release_notes.py"))["release_notes"]
CHANGELOG = "# Changelog\n\n## 0.2.0, 2030-01-31\n- New.\n- More.\n\n## 0.1.0, unreleased\n- Old.\n"


def test_notes_are_the_section_of_the_tag() -> None:
    assert release_notes("v0.2.0", "0.2.0", CHANGELOG) == "- New.\n- More.\n"


@pytest.mark.parametrize(("tag", "version"), [("v0.2.1", "0.2.0"), ("v0.3.0", "0.3.0"), ("v0.1.0", "0.1.0")])
def test_disagreement_makes_no_release(tag: str, version: str) -> None:
    """Another version, one without a section, one without a date."""
    with pytest.raises(SystemExit):
        release_notes(tag, version, CHANGELOG)


def test_the_changelog_begins_with_the_current_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert text.partition("\n## ")[2].startswith(f"{project['version']}, ")
