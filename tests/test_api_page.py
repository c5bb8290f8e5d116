"""Docstrings of the public names are complete, and docs/api.md agrees with them and with the signatures.

The reference of the site is made from the docstrings (docs/tools/site.py)."""

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Callable
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
        nodes = ast.walk(ast.parse(textwrap.dedent(inspect.getsource(cls))))
        stored = [node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)]
        names = [node.attr for node in stored if isinstance(node.value, ast.Name) and node.value.id == "self"]
    return {name for name in names if not name.startswith("_")}


def methods(cls: type) -> dict[str, Callable[..., Any]]:
    found = {name: getattr(value, "__func__", value) for name, value in vars(cls).items() if name[0] != "_"}
    return {name: value for name, value in found.items() if inspect.isfunction(value)}


def parameters(function: Callable[..., Any]) -> set[str]:
    return set(inspect.signature(function).parameters) - {"self"}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_list_parameters_and_result(name: str) -> None:
    assert set(section(FUNCTIONS[name], "Args")) == parameters(FUNCTIONS[name])
    assert "\nReturns:\n" in inspect.getdoc(FUNCTIONS[name])


@pytest.mark.parametrize("name", CLASSES)
def test_docstrings_list_attributes_and_parameters_of_methods(name: str) -> None:
    """Parameters in a section, all of them; or somewhere in a text of a few lines."""
    cls = CLASSES[name]
    assert set(section(cls, "Attributes")) == attributes(cls)
    for method, function in methods(cls).items():
        listed, text = set(section(function, "Args")), inspect.getdoc(function)
        assert text, method
        named = {each for each in parameters(function) if re.search(rf"\b{each}\b", text)}
        assert (listed or named) == parameters(function), method


# docs/api.md

CALLABLE = PUBLIC | methods(lapgs_wgpu.Trainer)
CALLS = [call for call in re.findall(r"`(\w+)\(([^`]*)\)`", PAGE) if call[0] in CALLABLE]
SIGNATURES = re.findall(r"^[|* ]*`(\w+)\(([^`]*)\)`", PAGE, re.MULTILINE)  # those that begin a line


@pytest.mark.parametrize(("name", "written"), [call for call in SIGNATURES if call[0] in CALLABLE])
def test_page_states_signatures(name: str, written: str) -> None:
    """Names and kinds of the parameters that the page shows, and their defaults as they are written in the code."""
    actual = inspect.signature(CALLABLE[name]).parameters
    arguments = ast.parse(f"def f({written}): ...").body[0].args  # type: ignore[attr-defined]
    for parameter in (*arguments.args, *arguments.kwonlyargs):
        keyword_only = actual[parameter.arg].kind is inspect.Parameter.KEYWORD_ONLY
        assert keyword_only == (parameter in arguments.kwonlyargs), parameter.arg
    shown = dict(zip([each.arg for each in arguments.args[::-1]], arguments.defaults[::-1], strict=False))
    shown |= {each.arg: default for each, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)}
    for parameter, default in shown.items():
        real = actual[parameter].default
        texts = {repr(real), getattr(real, "__name__", "{}" if repr(real) == "<factory>" else repr(real))}
        assert default is None or ast.unparse(default) in texts, parameter


def test_calls_on_the_page_name_parameters_that_exist() -> None:
    assert {"load_config", "load_dataset", "Trainer", "Parts", "load"} <= {name for name, _ in CALLS}
    for name, written in CALLS:
        assert set(re.findall(r"(?<![\w.])(\w+)=", written)) <= parameters(CALLABLE[name]), f"{name}({written})"


def rows(heading: str) -> dict[str, str]:
    """Name -> text of the lines of a section's tables."""
    part = PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    found = {}
    for first, text in re.findall(r"^\| ([^|]+) \| (.*) \|$", part, re.MULTILINE):
        found |= dict.fromkeys(re.findall(r"`(\w+)(?=[`(])", first), text)
    return found


def shapes(text: str) -> list[str]:
    return sorted(re.findall(r"\([NMD],[^)]*\)", " ".join(text.split())))


@pytest.mark.parametrize(
    ("heading", "cls"),
    [("A field of your own", lapgs_wgpu.Deformation), ("A density rule of your own", lapgs_wgpu.DensityState)],
)
def test_page_lists_fields_and_shapes(heading: str, cls: type) -> None:
    documented, listed = section(cls, "Attributes"), rows(heading)
    listed.pop(cls.__name__, None)  # a head of the table
    assert {name: shapes(text) for name, text in listed.items()} == {
        name: shapes(text) for name, text in documented.items()
    }


def test_page_lists_the_trainer() -> None:
    cls = lapgs_wgpu.Trainer
    properties = {name for name, value in vars(cls).items() if isinstance(value, property)}
    assert set(rows("A trainer")) == attributes(cls) | properties | set(methods(cls))
