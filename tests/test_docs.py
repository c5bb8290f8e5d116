"""The documents: links and anchors lead somewhere, commands are understood by their programs, options that prose names
exist, and Python runs as it stands."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
import run_table

from lapgs_wgpu import cli, doctor_cli, prepare_cli
from lapgs_wgpu.train.presets import config_keys, load_config
from lapgs_wgpu.viewer import options as view_options

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in DOCUMENTS}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def blocks(text: str, language: str) -> list[str]:
    """The contents of the fenced blocks of a language; those without one are commands for a shell."""
    return [block for name, block in FENCE.findall(text) if name == language]


# Python; docs/api.md has tests/test_api.py


@pytest.mark.parametrize("file", ["README.md", "docs/training.md", "docs/format.md"])
def test_python_runs_as_it_stands(
    file: str, trained_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained_run, "runs/demo")
    shutil.copy("runs/demo/checkpoint.ply", ".")
    for code in blocks(TEXTS[file], "python"):
        exec(code, {})


# Links


def anchors(text: str) -> set[str]:
    """Of the headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", TEXTS)
def test_links_lead_somewhere(name: str) -> None:
    for link in re.findall(r"\]\((?!https?://)([^) ]+)\)", TEXTS[name]):
        path, _, anchor = link.partition("#")
        target = (ROOT / name).parent / path if path else ROOT / name
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target.read_text(encoding="utf-8")), link


ADDRESSES = {link for text in TEXTS.values() for link in re.findall(r"https?:[^\s)>`'\"]*", text)}


@pytest.mark.skipif("LAPGS_LINKS" not in os.environ, reason="asks other sites: LAPGS_LINKS=1, as CI does every night")
@pytest.mark.parametrize("address", sorted(address for address in ADDRESSES if "localhost" not in address))
def test_addresses_answer(address: str) -> None:
    request = urllib.request.Request(address, headers={"User-Agent": "Mozilla/5.0"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        assert answer.status == 200


# Commands


def commands() -> set[str]:
    """Every command of the documents. Loops are written out; comments and redirections left out."""
    found = set()
    for block in (block for text in TEXTS.values() for block in blocks(text, "")):
        block = re.sub(r"<<'(\w+)'\n.*?^\1$", "", block, flags=re.DOTALL | re.MULTILINE)
        for head, name, words, body in re.findall(r"^(for (\w+) in (.*); do\n)(.*?)^done$", block, re.S | re.M):
            lines = "".join(body.replace(f"${name}", word) for word in words.split())
            block = block.replace(f"{head}{body}done", lines)
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition(" >")[0], comments=True)
            found |= {part.strip() for part in shlex.join(words).split(" '&&' ") if words}
    return found


def train(words: list[str]) -> None:
    given = cli.parse_options(words)
    assert given["preset"] or given["eval"] or given["resume"] or given["list_devices"], "names no preset"
    overrides = {key: given[key] for key in config_keys() if key in given}
    ablate = given["ablate"].split(",") if given["ablate"] else ()
    load_config(given["preset"] or "tiny", overrides, method=given["field"], ablate=ablate)


def make(words: list[str]) -> None:
    assert words[0] in re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def pip(words: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for named in re.findall(r"\[(.*)\]", " ".join(words)):
        assert set(named.split(",")) <= set(extras), named


def files(words: list[str]) -> None:
    """Of python and pytest: the scripts that they are given."""
    for word in words:
        assert not word.endswith(".py") or (ROOT / word).is_file(), word
    if words[:1] == ["benchmarks/run_table.py"]:
        run_table.read_spec(ROOT / run_table.options().parse_args(words[1:]).spec)


PROGRAMS: dict[str, Callable[[list[str]], object]] = {
    "lapgs-train": train,
    "lapgs-prepare": lambda words: prepare_cli.check_options(prepare_cli.options().parse_args(words)),
    "lapgs-doctor": lambda words: doctor_cli.options().parse_args(words),
    "lapgs-view": view_options.parse_options,
    "make": make,
    "pip": pip,
    "python": files,
    "pytest": files,
    **dict.fromkeys(("git", "cd", "ssh"), len),  # others that are not ours
}


def program_and_words(command: str) -> tuple[str, list[str]]:
    """Without variables of the environment."""
    words = shlex.split(command)
    while re.match(r"[A-Z_]+=", words[0]):
        words.pop(0)
    return words[0].removeprefix(".venv/bin/"), words[1:]


@pytest.mark.parametrize("command", sorted(commands()))
def test_programs_understand_their_commands(command: str) -> None:
    """By their own parsers: an option that was renamed fails, and so does a key, preset or value that is not there."""
    program, words = program_and_words(command)
    PROGRAMS[program](words)


def test_make_bench_understands_its_arguments() -> None:
    given = [words[1].removeprefix("ARGS=") for _, words in map(program_and_words, commands()) if "bench" in words[:-1]]
    assert given
    parse = "import json, runpy, sys; sys.path.insert(0, 'benchmarks')"
    parse += "; options = runpy.run_path('benchmarks/__main__.py')['options']"
    parse += "; [options().parse_args(words) for words in json.loads(sys.argv[1])]"
    lists = json.dumps([shlex.split(arguments) for arguments in given])
    subprocess.run([sys.executable, "-c", parse, lists], cwd=ROOT, check=True)


def test_toml_can_be_read(tmp_path: Path) -> None:
    for block in (block for text in TEXTS.values() for block in blocks(text, "toml")):
        (tmp_path / "a.toml").write_text(block)
        assert (
            load_config(tmp_path / "a.toml") if block.startswith("base =") else run_table.read_spec(tmp_path / "a.toml")
        )


# What the documents name


@pytest.mark.parametrize("program", [name for name in PROGRAMS if name.startswith("lapgs-")])
def test_options_in_prose_exist(program: str) -> None:
    done = subprocess.run([Path(sys.executable).with_name(program), "--help"], capture_output=True, text=True)
    for name, text in TEXTS.items():
        for span in re.findall(r"`([^`\n]+)`", FENCE.sub("", text)):
            if span.removeprefix(".venv/bin/").split()[:1] == [program]:
                for option in re.findall(r"(?<![\w-])--[a-z][\w.-]*", span):
                    assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", done.stdout), f"{name}: {option}"


@pytest.mark.parametrize("name", sorted(TEXTS.keys() - {"docs/format.md"}))  # which has parameters, not keys
def test_keys_in_prose_exist(name: str) -> None:
    """`table.key` of the configuration, wherever it is named."""
    keys = set(config_keys())
    tables = "|".join({key.split(".")[0] for key in keys if "." in key})
    for key in re.findall(rf"`(?:--)?((?:{tables})\.(?!npy|js|py)\w+(?:\.\w+)*)[` ]", TEXTS[name]):
        assert any(each == key or each.startswith(f"{key}.") for each in keys), key


@pytest.mark.parametrize("name", TEXTS)
def test_files_in_prose_exist(name: str) -> None:
    """Those with a suffix of code, from the top of the repository or from one of its packages."""
    tops = [ROOT / top for top in (".", "lapgs_wgpu", "lapgs_wgpu/motion", "shaders")]
    for file in re.findall(r"`([a-z_0-9]+(?:/[a-z_0-9]+)+\.(?:py|wgsl|js))`", TEXTS[name]):
        assert any((top / file).is_file() for top in tops), file


def test_the_list_of_passes_names_every_shader() -> None:
    shaders = {file.stem for file in (ROOT / "shaders").glob("*.wgsl")}
    assert shaders <= set(re.findall(r"`(\w+)`", TEXTS["docs/architecture.md"]))
