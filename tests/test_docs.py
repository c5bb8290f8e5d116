"""The documents: Python in them runs as it stands, links and anchors lead somewhere, every command is understood by its
program, and those that take less than a minute are run."""

from __future__ import annotations

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
from urllib.parse import urlsplit

import pytest

from lapgs_wgpu import cli, doctor_cli, prepare_cli, table_cli, train_options
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.table import read_spec
from lapgs_wgpu.train.presets import config_keys, load_config
from lapgs_wgpu.viewer import cli as view_cli
from lapgs_wgpu.viewer import options as view_options

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in DOCUMENTS}
LANGUAGES = {
    "python",
    "wgsl",
    "js",
    "bibtex",
    "text",
    "toml",
}  # of fenced blocks; those without one are commands for a shell


def blocks(text: str) -> list[tuple[str, str]]:
    """Language and content of each fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.S | re.M)


@pytest.fixture(scope="module")
def finished(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which `make demo` has run, with fewer steps; its capture lies beside."""
    folder = tmp_path_factory.mktemp("finished")
    short = "--steps 20 --points.count 500 --discovery.enabled false"
    run = folder / "runs" / "demo"
    assert cli.train_command(["demo", "--data", "synthetic", "--out", str(run), *short.split()]) == 0
    return folder


@pytest.fixture
def here(finished: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(finished)
    return finished


# Python

EXAMPLES = [
    (file, code)
    for file in ("README.md", "docs/training.md", "docs/format.md")  # docs/api.md: tests/test_api.py
    for language, code in blocks(TEXTS[file])
    if language == "python"
]


@pytest.mark.parametrize(("file", "code"), EXAMPLES, ids=[file for file, _ in EXAMPLES])
def test_example(here: Path, file: str, code: str) -> None:
    shutil.copy(here / "runs/demo/checkpoint.ply", here)
    names: dict = {}
    exec(code, names)
    if file == "docs/format.md":
        assert names["tensors"]["gaussians.means"].shape == (500, 3)
    else:
        assert names["picture" if "picture" in names else "image"].shape == (240, 320, 3)


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
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), link


def addresses() -> list[str]:
    """Of other sites."""
    found = {link for text in TEXTS.values() for link in re.findall(r"https?:[^\s)>`'\"]*", text)}
    return sorted(link for link in found if "localhost" not in link)


def test_addresses_are_well_formed() -> None:
    for link in addresses():
        parts = urlsplit(link)
        assert parts.scheme == "https", link
        assert re.fullmatch(r"([\w-]+\.)+[a-z]{2,}", parts.netloc), link
        assert re.fullmatch(r"[\w./#~-]*[\w/]", parts.path or "/"), link


@pytest.mark.skipif("LAPGS_LINKS" not in os.environ, reason="asks other sites: LAPGS_LINKS=1, as CI does every night")
@pytest.mark.parametrize("link", addresses())
def test_addresses_answer(link: str) -> None:
    request = urllib.request.Request(link, headers={"User-Agent": "Mozilla/5.0"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        assert answer.status == 200


# Commands


def commands() -> list[tuple[str, str]]:
    """Every command of the documents: file and line. Loops are written out; comments and redirections left out."""
    found = []
    for name, text in TEXTS.items():
        for language, block in blocks(text):
            assert language in LANGUAGES | {""}, f"{name}: a block of {language}"
            if language:
                continue
            block = re.sub(r"<<'(\w+)'\n.*?^\1$", "", block, flags=re.S | re.M)
            for head, words, body in re.findall(r"^(for (?:\w+) in (.*); do\n)(.*?)^done$", block, re.S | re.M):
                lines = "".join(body.replace(f"${head.split()[1]}", word) for word in words.split())
                block = block.replace(f"{head}{body}done", lines)
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line.partition(" >")[0], comments=True)
                found += [(name, part.strip()) for part in shlex.join(words).split(" '&&' ") if words]
    return found


COMMANDS = commands()


def test_configurations_and_descriptions_of_tables_can_be_read(tmp_path: Path) -> None:
    found = [block for text in TEXTS.values() for language, block in blocks(text) if language == "toml"]
    assert found
    for block in found:
        (tmp_path / "a.toml").write_text(block)
        if block.startswith("base ="):
            load_config(tmp_path / "a.toml")
        else:
            assert read_spec(tmp_path / "a.toml")


def train(words: list[str]) -> None:
    given = train_options.parse_options(words)
    assert given["preset"] or given["eval"] or given["resume"] or given["list_devices"], "names no preset"
    overrides = {key: given[key] for key in config_keys() if key in given}
    ablate = (given["ablate"] or "").split(",") if given["ablate"] else []
    load_config(given["preset"] or "tiny", overrides, method=given["field"], ablate=ablate)


def table(words: list[str]) -> None:
    given = table_cli.options().parse_args(words)
    read_spec(ROOT / given.spec)


def prepare(words: list[str]) -> None:
    prepare_cli.check_options(prepare_cli.options().parse_args(words))


def python(words: list[str]) -> None:
    if words[0] == "-c":
        compile(words[1], "-c", "exec")
    elif words[0] != "-":  # its text is not a command
        assert (ROOT / words[0]).is_file(), words[0]


def pytest_(words: list[str]) -> None:
    for word in words:
        assert word in ("-m", "kernels") or (ROOT / word).is_file(), word


def make(words: list[str]) -> None:
    goals = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    goal, *variables = words
    assert goal in goals, goal
    for variable in variables:
        assert (goal, variable[:5]) == ("bench", "ARGS="), variable  # test_make_bench_...


def pip(words: list[str]) -> None:
    assert words[0] == "install"
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for named in re.findall(r"\[(.*)\]", words[1]):
        assert set(named.split(",")) <= set(extras), named


def torchrun(words: list[str]) -> None:
    number, (program, *rest) = words[1], words[2:]
    assert (words[0], number.isdigit(), program) == ("--nproc-per-node", True, ".venv/bin/lapgs-train")
    train(rest)


PROGRAMS: dict[str, Callable[[list[str]], object]] = {
    "lapgs-train": train,
    "lapgs-table": table,
    "lapgs-prepare": prepare,
    "lapgs-doctor": lambda words: doctor_cli.options().parse_args(words),
    "lapgs-view": view_options.parse_options,
    "python": python,
    "pytest": pytest_,
    "make": make,
    "pip": pip,
    "torchrun": torchrun,
    "git": len,  # and others that are not ours
    "cd": len,
    "ssh": len,
}


def split(command: str) -> tuple[str, list[str]]:
    """Program and words of a command, without variables of the environment."""
    words = shlex.split(command)
    while re.match(r"[A-Z_]+=", words[0]):
        words.pop(0)
    return words[0].removeprefix(".venv/bin/"), words[1:]


@pytest.mark.parametrize("command", sorted({command for _, command in COMMANDS}))
def test_programs_understand_their_commands(command: str) -> None:
    """By their own parsers: an option that was renamed fails, and so does a key, preset or value that is not there."""
    program, words = split(command)
    PROGRAMS[program](words)


def test_every_program_is_named() -> None:
    assert {split(command)[0] for _, command in COMMANDS} == set(PROGRAMS)


def test_make_bench_understands_its_arguments() -> None:
    given = [
        words[-1].removeprefix("ARGS=") for _, command in COMMANDS if (words := split(command)[1])[:1] == ["bench"]
    ]
    assert given
    parse = "import json, runpy, sys; sys.path.insert(0, 'benchmarks')"
    parse += "; options = runpy.run_path('benchmarks/__main__.py')['options']"
    parse += "; [options().parse_args(words) for words in json.loads(sys.argv[1])]"
    lists = json.dumps([shlex.split(arguments) for arguments in given])
    subprocess.run([sys.executable, "-c", parse, lists], cwd=ROOT, check=True)


# What commands in prose name; [brackets] and capitals stand for others.
INLINE = [
    (name, words[0], option)
    for name, text in TEXTS.items()
    for span in re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M))
    for words in [span.removeprefix(".venv/bin/").split()]
    if words and words[0] in ("lapgs-train", "lapgs-table", "lapgs-prepare", "lapgs-doctor", "lapgs-view")
    for option in re.findall(r"(?<![\w-])--[a-z][\w.-]*", span)
]


def test_options_in_prose_exist(capsys: pytest.CaptureFixture[str]) -> None:
    helps = {}
    for program, command in COMMAND_FUNCTIONS.items():
        with pytest.raises(SystemExit):
            command(["--help"])
        helps[program] = capsys.readouterr().out
    assert len(INLINE) > 10
    for name, program, option in INLINE:
        assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", helps[program]), f"{name}: {program} {option}"


COMMAND_FUNCTIONS: dict[str, Callable[[list[str]], int]] = {
    "lapgs-train": cli.train_command,
    "lapgs-table": table_cli.table_command,
    "lapgs-prepare": prepare_cli.prepare_command,
    "lapgs-doctor": doctor_cli.doctor_command,
    "lapgs-view": view_cli.view_command,
}
# What the documents name that only a reader has.
STANDS_FOR = {
    "CHECKPOINT.ply": "runs/demo/checkpoint.ply",
    "capture": "runs/synthetic",
    "runs/mine": "runs/demo",
    "runs/tones-learnt": "runs/demo",
}


def takes_a_moment(program: str, words: list[str]) -> bool:
    """Whether a command takes less than a minute on two cores, needs no screen, and no data of the reader's."""
    if program == "lapgs-view":
        return bool({"--screenshot", "--video", "--export"} & set(words))
    if program == "lapgs-train":
        return words[0] in ("--eval", "--list-devices") and "--lpips-weights" not in words
    return program == "lapgs-prepare" and words[0] == "--check"


QUICK = [(file, command) for file, command in COMMANDS if takes_a_moment(*split(command))]


@pytest.mark.parametrize(("file", "command"), QUICK, ids=[f"{file}: {command}" for file, command in QUICK])
def test_commands_that_take_a_moment_run(here: Path, file: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they stand, but videos of fewer pixels. lapgs-doctor: tests/test_doctor.py."""
    monkeypatch.setattr(view_cli, "_WINDOW_SIZE", (160, 90))
    program, words = split(command)
    words = [STANDS_FOR.get(word, re.sub(r"^runs/\w+/checkpoint", "runs/demo/checkpoint", word)) for word in words]
    assert COMMAND_FUNCTIONS[program]([*words, *(["--overwrite"] if "--export" in words else [])]) == 0, file


def test_the_command_in_results_that_writes_a_scene(here: Path) -> None:
    (code,) = {words[1] for _, command in COMMANDS for program, words in [split(command)] if "-c" in words}
    exec(code.replace("size=96", "size=24"), {})
    assert (here / "runs/tones/transforms_train.json").is_file()


def test_the_list_of_passes_names_every_shader() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    shaders = {file.stem for file in (ROOT / "shaders").glob("*.wgsl")}
    assert shaders <= set(re.findall(r"`(\w+)`", text))
