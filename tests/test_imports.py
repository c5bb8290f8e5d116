"""What may import what: gpu <- splat <- motion <- train <- cli, with data and io as leaves; and what `import` does."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import lapgs_wgpu
import lapgs_wgpu.viewer

PACKAGE = Path(lapgs_wgpu.__file__).parent

# For each part of the package, the parts that it may import besides itself. A dotted name allows that module alone.
ALLOWED = {
    "errors": set(),
    "progress": set(),
    "gpu": {"errors"},
    "splat": {"errors", "gpu"},
    "motion": {"errors", "gpu", "splat", "io"},
    "data": {
        "errors",
        "progress",
        "splat.camera",
        "io.atomic",
        "io.listing",
        "io.safe_json_toml",
        "io.dataclass_table",
        "io.ply_elements",
    },
    "io": {"errors", "splat.camera"},
    "train": {"errors", "progress", "gpu", "splat", "motion", "data", "io"},
    "discovery": {"errors", "progress", "gpu", "splat", "motion", "data", "train"},
    "run": {"errors", "progress", "gpu", "motion", "data", "io", "train", "discovery"},
    "command": {"errors", "gpu"},
    "viewer": {"errors", "command", "progress", "gpu", "splat", "motion", "data", "io"},
    "prepare": {
        "errors",
        "progress",
        "data",
        "splat.camera",
        "io.atomic",
        "io.folder_lock",
        "io.listing",
        "io.safe_json_toml",
    },
    "prepare_cli": {"errors", "command", "gpu", "prepare", "train", "run", "io.listing"},
    "doctor": {"errors", "command", "gpu", "splat"},
    "doctor_cli": {"errors", "command", "gpu", "doctor"},
    "cli": {
        "errors",
        "progress",
        "command",
        "gpu",
        "splat",
        "motion",
        "data",
        "io",
        "train",
        "run",
        "viewer",
    },
}
FOLDERS = {"": PACKAGE, "viewer": Path(lapgs_wgpu.viewer.__file__).parent}  # where the parts lie on the disk
FILES = sorted({Path(part) / file.relative_to(at) for part, at in FOLDERS.items() for file in at.rglob("*.py")})


def part_of(file: Path) -> str:
    """The part of the package to which a file belongs."""
    return file.parts[0].removesuffix(".py")


def imports(file: Path) -> list[str]:
    """The package's own modules that a file imports anywhere, dotted, without the package's name."""
    found = []
    folder = ("lapgs_wgpu", *file.parent.parts)
    home = FOLDERS["viewer"].parent if part_of(file) == "viewer" else PACKAGE
    for node in ast.walk(ast.parse((home / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join((*base, *((node.module,) if node.module else ())))
            found += [f"{module}.{alias.name}" for alias in node.names]
    return [name.removeprefix("lapgs_wgpu.") for name in found if name.split(".")[0] == "lapgs_wgpu"]


def test_every_part_has_a_rule() -> None:
    parts = {part_of(file) for file in FILES} - {"__init__", "__main__"}
    assert {"gpu", "splat", "motion", "data", "io"} <= parts
    assert parts - {"shaders", "configs", "viewer"} <= set(ALLOWED)


def test_the_table_of_layers_says_the_same() -> None:
    """Of the folders, in docs/architecture.md. All may import `errors` and `progress`, a command also `command`."""
    text = (Path(__file__).parents[1] / "docs/architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)/` \|.*\|(.*)\|$", text, re.MULTILINE)
    table = {part: set(re.findall(r"`([\w.]+)`", cell)) for part, cell in rows}
    folders = {part_of(file) for file in FILES if len(file.parts) > 1} & set(ALLOWED)
    everywhere = {"errors", "progress", "command"}
    assert table == {part: ALLOWED[part] - everywhere for part in folders} | {"shaders": set()}


@pytest.mark.parametrize("file", [file for file in FILES if part_of(file) in ALLOWED], ids=str)
def test_imports_go_downwards(file: Path) -> None:
    part = part_of(file)
    allowed = ALLOWED[part] | {part}
    for name in imports(file):
        assert any(name == each or name.startswith(f"{each}.") for each in allowed), f"{part} must not import {name}"


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """The sets of modules that reach each other through their imports."""

    def reached(start: str) -> set[str]:
        found: set[str] = set()
        waiting = [start]
        while waiting:
            new = graph[waiting.pop()] - found
            found |= new
            waiting += new
        return found

    reach = {module: reached(module) for module in graph}
    found = {frozenset({other for other in reach[module] if module in reach[other]}) for module in graph}
    return sorted((set(circle) for circle in found if circle), key=sorted)


def test_no_files_import_each_other_in_a_circle() -> None:
    """Imports for types alone count, too."""
    modules = {".".join(file.with_suffix("").parts).removesuffix(".__init__"): file for file in FILES}
    graph = {}
    for module, file in modules.items():
        named = {name if name in modules else name.rpartition(".")[0] for name in imports(file)}
        graph[module] = {name for name in named if name in modules and name != module}
    assert not circles(graph)


def test_the_rule_sees_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative ones, absolute ones, and those inside functions."""
    (tmp_path / "splat").mkdir()
    (tmp_path / "splat" / "odd.py").write_text(
        "from . import camera\nfrom ..gpu.device import Device\nfrom .. import train\nimport lapgs_wgpu.io.ply\n"
        "def f():\n    from lapgs_wgpu.motion import field\nimport numpy\nfrom .camera import Camera\n"
    )
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    expected = ["splat.camera", "gpu.device.Device", "train", "io.ply", "motion.field", "splat.camera.Camera"]
    assert sorted(imports(Path("splat/odd.py"))) == sorted(expected)


# What `import` does

SLOW = {"torch", "wgpu", "numpy", "scipy"}  # from a tenth of a second to several


def run(program: str) -> str:
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_import_is_light_and_silent() -> None:
    assert run("import lapgs_wgpu") == ""
    loaded = run("import sys, lapgs_wgpu; print(*sys.modules)").split()
    assert not SLOW & set(loaded)


@pytest.mark.parametrize(
    "module",
    [
        "errors",
        "io.checkpoint",
        "splat.camera",
        "data.load",
    ],
)
def test_readers_need_neither_torch_nor_a_device_nor_scipy(module: str) -> None:
    loaded = run(f"import sys, lapgs_wgpu.{module}; print(*sys.modules)").split()
    assert not {"torch", "wgpu", "scipy"} & set(loaded)


@pytest.mark.parametrize(
    ("command", "slow"),
    [
        ("viewer.cli.view_command", SLOW),
        ("cli.train_command", SLOW),
        ("prepare_cli.prepare_command", SLOW),
        ("doctor_cli.doctor_command", SLOW),
    ],
)
def test_help_loads_nothing_that_is_slow(command: str, slow: set[str]) -> None:
    """Which is what makes it quick: the test counts, since times depend on the machine."""
    module, name = command.rsplit(".", 1)
    program = f"""
import contextlib, io, sys
from lapgs_wgpu.{module} import {name}
shown = io.StringIO()
with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
    {name}(["--help"])
assert "--help" in shown.getvalue()
print(*sys.modules)"""
    assert not slow & set(run(program).split())


def test_torchs_threads_are_told_to_sleep() -> None:
    assert run("import os, lapgs_wgpu; print(os.environ['OMP_WAIT_POLICY'])").strip() == "PASSIVE"
    chosen = "import os; os.environ['OMP_WAIT_POLICY'] = 'ACTIVE'; import lapgs_wgpu; "
    assert run(chosen + "print(os.environ['OMP_WAIT_POLICY'])").strip() == "ACTIVE", "what the user chose stands"


def test_no_module_opens_a_device_when_imported() -> None:
    modules = ["lapgs_wgpu." + ".".join(file.with_suffix("").parts) for file in FILES if file.name[0] != "_"]
    program = (
        f"import importlib\nfor name in {modules!r}: importlib.import_module(name)\n"
        "from lapgs_wgpu.gpu import device\nprint(device._instance.cache_info().currsize)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "0"


def test_the_version_is_that_of_pyproject() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert lapgs_wgpu.__version__ == project["version"]


def test_public_names_are_there() -> None:
    for name in lapgs_wgpu.__all__:
        assert getattr(lapgs_wgpu, name).__name__ == name
    with pytest.raises(AttributeError, match="module 'lapgs_wgpu' has no attribute 'no_such_name'"):
        _ = lapgs_wgpu.no_such_name
