"""Presets: configurations in TOML, by name or from a file, with values overridden from the command line.

A file names every key, or starts from another preset (`base = "dnerf"`) and names what differs.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.resources
import json
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.documents import read_toml
from lapgs_wgpu.motion.fields.config import FieldKind
from lapgs_wgpu.train.config import Config

Table = dict[str, Any]

# What only the paper's method has, besides its field: left out with every other one.
PAPER_ONLY = {"loss.pyramid": 0.0, "loss.ncc": 0.0, "density.split": "plain"}
# The parts of the method that --ablate takes out, and what is set then.
ABLATIONS: dict[str, dict[str, Any]] = {
    "laplacian": {"field.motion": "mlp"},
    "dynamics": {"field.dynamics": 0},
    "split": {"density.split": "plain"},
    "lap": {"loss.pyramid": 0.0},
    "ncc": {"loss.ncc": 0.0},
    "dy": {"loss.dynamics_mode": "off"},
    "hash": {"field.temporal_hash": False},
    "appearance": {"field.appearance": "none"},
}

LARGEST_NUMBER = 2**31 - 1  # no key has a use for more


def preset_names() -> list[str]:
    """The presets that come with the package."""
    files = importlib.resources.files("lapgs_wgpu.configs").iterdir()
    return sorted(Path(file.name).stem for file in files if file.name.endswith(".toml"))


def load_config(
    preset: str,
    overrides: Mapping[str, str | list[str]] | None = None,
    *,
    method: str | None = None,
    ablate: Iterable[str] = (),
) -> Config:
    """A preset by name, or a .toml file by path (such as an earlier run's config.toml), with some values overridden.

    overrides: dotted key -> text, or texts of a tuple's entries, as they stand on a command line.
    method: a field's kind, without what belongs to the paper's method only (PAPER_ONLY). ablate: parts of the paper's
    method that are left out (ABLATIONS). Overrides come last.
    Raises InputError where the preset, a key or a value is not valid.
    """
    table = _read(preset)
    known = {key.name: key.kind for key in config_keys()}
    for key, value in _shorthands(method, ablate).items():
        _set(table, key, value)
    for key, text in (overrides or {}).items():
        if key not in known:
            raise InputError(f"there is no option --{key}{did_you_mean(key, known)}.")
        _set(table, key, _checked(known[key], _from_text(text, known[key]), f"--{key}"))
    return typing.cast(Config, _build(Config, table, preset, ""))


def build_config(
    preset: str, table: Table, source: str, *, method: str | None = None, ablate: Iterable[str] = ()
) -> Config:
    """A preset, by name or by path, with a nested table of values laid over it; method, ablate as in `load_config`.

    source: where the table stands, for the text of an InputError.
    """
    base = _read(preset)
    for key, value in _shorthands(method, ablate).items():
        _set(base, key, value)
    return typing.cast(Config, _build(Config, merge(base, table), source, ""))


def _shorthands(method: str | None, ablate: Iterable[str]) -> dict[str, Any]:
    """Key -> value of what --field and --ablate stand for."""
    values: dict[str, Any] = {}
    if method is not None:
        values["field.kind"] = _checked(FieldKind, method, "--field")
        values |= PAPER_ONLY if method != "laplacian" else {}
    for part in ablate:
        if part not in ABLATIONS:
            hint = did_you_mean(part, ABLATIONS)
            raise InputError(f"--ablate knows {', '.join(ABLATIONS)}, not {shown(part)}{hint}.")
        values |= ABLATIONS[part]
    return values


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """ "; did you mean X?" for a name that is close to a known one, else nothing."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else ""


class Key(NamedTuple):
    """A key of the configuration: its dotted name, its type, and what it means."""

    name: str
    kind: Any
    help: str


def config_keys(cls: type = Config, prefix: str = "", about: str = "") -> Iterator[Key]:
    """Every key of the configuration."""
    types = _types(cls)
    for field in dataclasses.fields(cls):
        text = ", ".join(filter(None, (about, field.metadata.get("help", ""))))
        if dataclasses.is_dataclass(types[field.name]):
            yield from config_keys(types[field.name], f"{prefix}{field.name}.", text)
        else:
            yield Key(prefix + field.name, types[field.name], text)


def write_toml(table: Mapping[str, Any]) -> str:
    """TOML text of nested dictionaries of texts, numbers, truth values and tuples."""
    return "\n".join(_toml_lines(table, "")).strip() + "\n"


def _read(preset: str, seen: tuple[str, ...] = ()) -> Table:
    """The table of a preset, laid over its base's."""
    if preset in seen:
        raise InputError(f"{preset}: its base leads back to itself ({' -> '.join((*seen, preset))}).")
    if preset.endswith(".toml"):
        file = Path(preset)
        if not file.is_file():
            raise InputError(f"{preset} does not exist; give a preset ({', '.join(preset_names())}) or a .toml file.")
    elif preset in preset_names():
        file = Path(str(importlib.resources.files("lapgs_wgpu.configs") / f"{preset}.toml"))
    else:
        names = preset_names()
        hint = did_you_mean(preset, names) or f"; there are {', '.join(names)}, or give a .toml file."
        raise InputError(f"there is no preset {preset!r}{hint}")
    table = read_toml(file)
    table.pop("record", None)  # what a run noted about itself
    base = table.pop("base", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise InputError(f"{file}: base must be the name of a preset, got {shown(base)}.")
    return merge(_read(base, (*seen, preset)), table)


def merge(below: Table, above: Table) -> Table:
    """A nested table with another one laid over it."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(below.get(key), dict)
        merged[key] = merge(below[key], value) if both else value
    return merged


def _set(table: Table, key: str, value: Any) -> None:
    *path, name = key.split(".")
    for part in path:
        inner = table.get(part)
        table[part] = table = dict(inner) if isinstance(inner, dict) else {}
    table[name] = value


def _types(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _build(cls: type, table: Any, source: str, prefix: str) -> Any:
    """A dataclass from a table; every key must be known, every value of its type."""
    if not isinstance(table, dict):
        raise InputError(f"{source}: {prefix.rstrip('.')} must be a table, got {shown(table)}.")
    types = _types(cls)
    for key in table:
        if key not in types:
            raise InputError(f"{source}: there is no key {prefix}{key}{did_you_mean(key, types)}.")
    values = {}
    for field in dataclasses.fields(cls):
        name, kind = field.name, types[field.name]
        if name in table:
            inner = dataclasses.is_dataclass(kind)
            values[name] = (
                _build(typing.cast(type, kind), table[name], source, f"{prefix}{name}.")
                if inner
                else _checked(kind, table[name], f"{source}: {prefix}{name}")
            )
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise InputError(f'{source} lacks the key {prefix}{name}; add it, or start the file with base = "dnerf".')
    try:
        return cls(**values)
    except ValueError as error:
        raise InputError(f"{source}: {prefix.rstrip('.')}: {error}.") from None


def _checked(kind: Any, value: Any, where: str) -> Any:
    """A TOML value as a value of this type; numbers must lie between 0 and LARGEST_NUMBER."""
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        if value in parts:
            return value
        hint = did_you_mean(value, parts) if isinstance(value, str) else ""
        raise InputError(f"{where} must be {' or '.join(parts)}, got {shown(value)}{hint}.")
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple) or len(value) != len(parts):
            raise InputError(f"{where} must be {len(parts)} numbers, got {shown(value)}.")
        return tuple(_checked(part, entry, where) for part, entry in zip(parts, value, strict=True))
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise InputError(f"{where} must be {_KINDS[kind]}, got {shown(value)}.")
    if kind in (int, float) and not 0 <= value <= LARGEST_NUMBER:
        raise InputError(f"{where} must lie between 0 and {LARGEST_NUMBER}, got {shown(value)}.")
    return float(value) if kind is float else value


_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


def _from_text(text: str | list[str], kind: Any) -> Any:
    """Words of the command line as a value of this type; what is no number stays text, for `_checked` to refuse."""
    if isinstance(text, list):
        return [_from_text(entry, part) for entry, part in zip(text, typing.get_args(kind), strict=True)]
    if kind is bool:
        return {"true": True, "false": False}.get(text, text)
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            return text
    return text


def _toml_lines(table: Mapping[str, Any], prefix: str) -> Iterator[str]:
    inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    yield from (f"{key} = {_toml_value(value)}" for key, value in table.items() if key not in inner)
    for key, value in inner.items():
        yield from ("", f"[{prefix}{key}]")
        yield from _toml_lines(value, f"{prefix}{key}.")


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(_toml_value(entry) for entry in value)}]"
