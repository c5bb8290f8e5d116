"""Docstrings of the public names are complete, and docs/api.md agrees with them and with the signatures.

The reference of the site is made from the docstrings (docs/tools/site.py)."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import lapgs_wgpu

PUBLIC = {name: getattr(lapgs_wgpu, name) for name in lapgs_wgpu.__all__}
CLASSES = {name: value for name, value in PUBLIC.items() if inspect.isclass(value)}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if not inspect.isclass(value)}
PAGE = (Path(__file__).parents[1] / "docs" / "api.md").read_text(encoding="utf-8")


def section(documented: Any, title: str) -> dict[str, str]:
    """Name -> text of the entries of a docstring's section; empty without it."""
    match = re.search(rf"^{title}:\n((?:    .*\n|\n)+)", inspect.getdoc(documented) + "\n", re.MULTILINE)
    entries = re.split(r"^(?=\S)", textwrap.dedent(match[1]), flags=re.MULTILINE) if match else []
    return {name: text for name, _, text in (entry.partition(": ") for entry in entries if entry.strip())}


def attributes(cls: type) -> set[str]:
    """Public fields of a dataclass or tuple; otherwise the public attributes that methods set."""
    if dataclasses.is_dataclass(cls):
        names = [field.name for field in dataclasses.fields(cls) if field.init]
    elif issubclass(cls, tuple):
        names = list(cls._fields)  # type: ignore[attr-defined]
    else:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
        stored = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
        names = [
            node.attr
            for node in stored
            if isinstance(node.ctx, ast.Store) and isinstance(node.value, ast.Name) and node.value.id == "self"
        ]
    return {name for name in names if not name.startswith("_")}


def methods(cls: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    for name, value in vars(cls).items():
        function = getattr(value, "__func__", value)
        if inspect.isfunction(function) and not name.startswith("_"):
            yield name, function


def parameters(function: Callable[..., Any]) -> set[str]:
    return set(inspect.signature(function).parameters) - {"self"}


@pytest.mark.parametrize("name", CLASSES)
def test_docstrings_list_the_attributes(name: str) -> None:
    assert set(section(CLASSES[name], "Attributes")) == attributes(CLASSES[name])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_list_parameters_and_result(name: str) -> None:
    assert set(section(FUNCTIONS[name], "Args")) == parameters(FUNCTIONS[name])
    assert "\nReturns:\n" in inspect.getdoc(FUNCTIONS[name])


@pytest.mark.parametrize("name", CLASSES)
def test_docstrings_of_methods_name_their_parameters(name: str) -> None:
    """In a section, all of them; or somewhere in a text of a few lines."""
    cls = CLASSES[name]
    for method, function in methods(cls):
        assert inspect.getdoc(function), method
        listed = set(section(function, "Args"))
        missing = {each for each in parameters(function) if not re.search(rf"\b{each}\b", inspect.getdoc(function))}
        assert listed == parameters(function) if listed else not missing, (method, missing)
    if not dataclasses.is_dataclass(cls) and not issubclass(cls, tuple):
        assert set(section(cls.__init__, "Args")) == parameters(cls.__init__)


# docs/api.md ---------------------------------------------------------------------------------------------------------

# Signatures stand at the beginning of a line; calls within the text.
CALLABLE = PUBLIC | dict(methods(lapgs_wgpu.Trainer))
CALLS = [call for call in re.findall(r"`(\w+)\(([^`]*)\)`", PAGE) if call[0] in CALLABLE]
LEADING = [line.lstrip("|* ") for line in PAGE.splitlines()]
SIGNATURES = [
    call
    for line in LEADING
    if line.startswith("`")
    for call in re.findall(r"`(\w+)\(([^`]*)\)`", line.split(" |")[0].split(":")[0])
    if call[0] in CALLABLE
]


def test_page_has_all_functions_and_parts() -> None:
    shown = {name for name, _ in SIGNATURES}
    assert {"load_config", "load_dataset", "Trainer", "Parts", "list_devices", "open_device"} <= shown
    assert {"Regularizer", "TorchLoss", "WgslLoss", "Change", "step", "evaluate", "state"} <= shown


@pytest.mark.parametrize(("name", "written"), SIGNATURES)
def test_page_states_signatures(name: str, written: str) -> None:
    """Names, kinds and defaults of the parameters that the page shows."""
    actual = inspect.signature(CALLABLE[name]).parameters
    for parameter in eval_signature(written).values():
        assert parameter.name in actual, parameter.name
        real = actual[parameter.name]
        assert parameter.kind == real.kind, parameter.name
        if parameter.default is not parameter.empty:
            assert parameter.default == shown_default(real), parameter.name


def eval_signature(written: str) -> dict[str, inspect.Parameter]:
    """The parameters as they are written, with the text of each default."""
    arguments = ast.parse(f"def f({written}): ...").body[0].args  # type: ignore[attr-defined]
    defaults = [None] * (len(arguments.args) - len(arguments.defaults)) + arguments.defaults
    kinds = inspect.Parameter
    pairs = [
        (each, default, kinds.POSITIONAL_OR_KEYWORD) for each, default in zip(arguments.args, defaults, strict=True)
    ]
    pairs += [
        (each, default, kinds.KEYWORD_ONLY)
        for each, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    ]
    return {
        each.arg: kinds(each.arg, kind, default=kinds.empty if default is None else ast.unparse(default))
        for each, default, kind in pairs
    }


def shown_default(parameter: inspect.Parameter) -> str:
    default = parameter.default
    if callable(default) and hasattr(default, "__name__"):
        return default.__name__
    return "{}" if repr(default) == "<factory>" else repr(default)


def test_calls_on_the_page_name_parameters_that_exist() -> None:
    for name, written in CALLS:
        for keyword in re.findall(r"(?<![\w.])(\w+)=", written):
            assert keyword in parameters(CALLABLE[name]), f"{name}({written})"


def rows(heading: str) -> dict[str, str]:
    """Name -> text of the lines of a section's tables."""
    part = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert part
    found = {}
    for first, text in re.findall(r"^\| ([^|]+) \| (.*) \|$", part[1], re.MULTILINE):
        found |= dict.fromkeys(re.findall(r"`(\w+)(?=[`(])", first), text)
    return found


def shapes(text: str) -> list[str]:
    """The shapes that a text names, and whatever else it puts in brackets that begin like one."""
    return sorted(re.findall(r"\([NMD],[^)]*\)", " ".join(text.split())))


@pytest.mark.parametrize(
    ("heading", "cls"),
    [("A field of your own", lapgs_wgpu.Deformation), ("A density rule of your own", lapgs_wgpu.DensityState)],
)
def test_page_lists_fields_and_shapes(heading: str, cls: type) -> None:
    documented, listed = section(cls, "Attributes"), rows(heading)
    listed.pop(cls.__name__, None)  # a head of the table
    assert set(listed) == set(documented)
    for name, text in listed.items():
        assert shapes(text) == shapes(documented[name]), name


def test_page_lists_the_trainer() -> None:
    cls = lapgs_wgpu.Trainer
    properties = {name for name, value in vars(cls).items() if isinstance(value, property)}
    assert set(rows("A trainer")) == attributes(cls) | properties | dict(methods(cls)).keys()


def test_page_lists_what_a_step_and_a_change_tell() -> None:
    for name, opening in (("StepResult", "A `StepResult` has "), ("Change", "`Change(keep, added)`: ")):
        paragraph = PAGE[PAGE.index(opening) :].split("\n\n")[0]
        assert set(section(PUBLIC[name], "Attributes")) <= set(re.findall(r"`(\w+)`", paragraph))
