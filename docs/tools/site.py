"""Pages of the site that are made from the code, and files of the repository to which pages link.

MkDocs calls the functions below by their names.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import lapgs_wgpu
from lapgs_wgpu.cli import keys_help
from lapgs_wgpu.train.presets import preset_names

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
_UPWARD = re.compile(r"\]\(((?:\.\./)+[\w./-]+)(#[\w-]+)?\)")  # links that may lead out of docs/


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages, and every file outside docs/ to which a page links."""
    files.append(File.generated(config, "presets.md", content=presets_page()))
    files.append(File.generated(config, "reference.md", content=reference_page()))
    linked = set()
    for page in DOCS.rglob("*.md"):
        linked |= {_outside(page, match[1]) for match in _UPWARD.finditer(page.read_text(encoding="utf-8"))}
    for path in sorted(linked - {""}):
        files.append(File.generated(config, f"repository/{path}{_suffix(path)}", abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links out of docs/ lead to the copies that `on_files` has added."""
    upward = "../" * page.file.src_uri.count("/")

    def link(match: re.Match[str]) -> str:
        path = _outside(DOCS / page.file.src_uri, match[1])
        return f"]({upward}repository/{path}{_suffix(path)}{match[2] or ''})" if path else match[0]

    return _UPWARD.sub(link, markdown)


def _outside(page: Path, link: str) -> str:
    """The path in the repository to which a page's link leads; empty for files in docs/."""
    target = (page.parent / link).resolve()
    return "" if target.is_relative_to(DOCS) else target.relative_to(ROOT).as_posix()


def _suffix(path: str) -> str:
    return ".txt" if path.endswith(".md") else ""  # MkDocs would make a page of it, whose own links lead nowhere


_ABOUT_PRESETS = (
    "`lapgs-train PRESET --data DIR --KEY VALUE`: a preset is a set of values; any key can follow on the command line. "
    "This page is made from the configuration."
)


def presets_page() -> str:
    """Every preset, and every key with its help text and its value in the preset dnerf."""
    lines = ["# Presets and keys", "", _ABOUT_PRESETS, "", "## Presets", ""]
    for file in sorted((ROOT / "configs").glob("*.toml")):
        about = " ".join(line.lstrip("# ") for line in _head(file.read_text(encoding="utf-8")))
        lines.append(f"- `{file.stem}`: {about}")
    lines += ["", f"In all: {', '.join(f'`{name}`' for name in preset_names())}.", "", "## Keys", ""]
    return "\n".join([*lines, "```text", keys_help("dnerf"), "```"]) + "\n"


def _head(text: str) -> list[str]:
    """The comment at the head of a file."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line)
    return lines


def reference_page() -> str:
    """The public names, by their docstrings."""
    lines = ["# Reference", "", "All public names, made from their docstrings: `from lapgs_wgpu import NAME`.", ""]
    for name in lapgs_wgpu.__all__:
        home = next(home for home, names in lapgs_wgpu._NAMES.items() if name in names)
        lines += [f"::: lapgs_wgpu.{home}.{name}", ""]
    return "\n".join(lines)
