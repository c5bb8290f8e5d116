"""Print the section of CHANGELOG.md that belongs to a tag. Fails unless tag, pyproject.toml and CHANGELOG.md agree.

python .ci/release_notes.py v0.1.0
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def release_notes(tag: str, version: str, changelog: str) -> str:
    """The section's text. Raises SystemExit with a sentence if tag, version or section do not agree."""
    if tag != f"v{version}":
        raise SystemExit(f"the tag is {tag}, but pyproject.toml has version {version}: the tag must be v{version}")
    sections = re.split(r"^## ", changelog, flags=re.MULTILINE)[1:]
    for section in sections:
        title, _, text = section.partition("\n")
        if title.split(",")[0].strip() != version:
            continue
        if not re.fullmatch(r"\S+, \d{4}-\d{2}-\d{2}", title.strip()):
            raise SystemExit(f'CHANGELOG.md has the title "{title.strip()}": a release needs "{version}, YYYY-MM-DD"')
        return text.strip() + "\n"
    raise SystemExit(f"CHANGELOG.md has no section {version}")


if __name__ == "__main__":
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    notes = release_notes(sys.argv[1], project["version"], (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    print(notes, end="")
