"""Configuration dataclasses from parsed TOML and JSON: the one place that checks keys, types and ranges."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Iterable
from typing import Any, Literal, TypeVar

from lapgs_wgpu.errors import InputError, shown

T = TypeVar("T")
LARGEST_NUMBER = 2**31 - 1  # no key has a use for more


def build_dataclass(cls: type[T], table: Any, source: str, prefix: str = "") -> T:
    """A dataclass from a parsed TOML or JSON table. Every key must be known, and every value of the field's type.

    source: where the table comes from, for errors. prefix: of the keys in errors. Missing keys take the field's
    default. Raises InputError.
    """
    if not isinstance(table, dict):
        raise InputError(f"{source}: {prefix.rstrip('.')} must be a table, got {shown(table)}.")
    types = field_types(cls)
    for key in table:
        if key not in types:
            raise InputError(f"{source}: there is no key {prefix}{key}{did_you_mean(key, types)}.")
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        name, kind = field.name, types[field.name]
        if name in table:
            inner = dataclasses.is_dataclass(kind)
            values[name] = (
                build_dataclass(typing.cast(type, kind), table[name], source, f"{prefix}{name}.")
                if inner
                else checked(kind, table[name], f"{source}: {prefix}{name}")
            )
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise InputError(f'{source} lacks the key {prefix}{name}; add it, or start the file with base = "dnerf".')
    try:
        return cls(**values)
    except ValueError as error:
        raise InputError(f"{source}: {prefix.rstrip('.')}: {error}.") from None


def checked(kind: Any, value: Any, where: str) -> Any:
    """A TOML or JSON value as a value of this type; numbers from 0 to LARGEST_NUMBER. Raises InputError."""
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        if value in parts:
            return value
        hint = did_you_mean(value, parts) if isinstance(value, str) else ""
        raise InputError(f"{where} must be {' or '.join(parts)}, got {shown(value)}{hint}.")
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple) or len(value) != len(parts):
            raise InputError(f"{where} must be {len(parts)} numbers, got {shown(value)}.")
        return tuple(checked(part, entry, where) for part, entry in zip(parts, value, strict=True))
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise InputError(f"{where} must be {_KIND_NAMES[kind]}, got {shown(value)}.")
    if kind in (int, float) and not 0 <= value <= LARGEST_NUMBER:
        raise InputError(f"{where} must lie between 0 and {LARGEST_NUMBER}, got {shown(value)}.")
    return float(value) if kind is float else value


_KIND_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


def field_types(cls: type) -> dict[str, Any]:
    """Field name of a dataclass -> its type."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """ "; did you mean X?" for a name that is close to a known one, else nothing."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else ""
