"""Dataclasses from parsed TOML and JSON: the one place that checks keys, types and ranges."""

import dataclasses
import difflib
import operator
import typing
from collections.abc import Iterable
from contextlib import suppress
from types import UnionType
from typing import Any, Literal, TypeVar

from lapgs_wgpu.errors import InputError, shown

T = TypeVar("T")
LARGEST_NUMBER = 2**31 - 1  # no key has a use for more
_LIMITS = {"above": operator.gt, "at_least": operator.ge, "below": operator.lt, "at_most": operator.le}


def option(text: str, default: Any = dataclasses.MISSING, **limits: float) -> Any:
    """A field of `Options`; one without a default must stand in every table.

    text: of the help. limits: above, at_least, below, at_most; of a tuple they hold for each entry.
    """
    return dataclasses.field(default=default, metadata={"help": text, "limits": limits})


class Options:
    """Base class of dataclasses made of `option`s. Raises ValueError for a value outside its limits."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            limits, value = field.metadata.get("limits", {}), getattr(self, field.name)
            for number in value if isinstance(value, tuple) else (value,):
                if not all(_LIMITS[name](number, limit) for name, limit in limits.items()):
                    allowed = " and ".join(f"{name.replace('_', ' ')} {limit:g}" for name, limit in limits.items())
                    raise ValueError(f"{field.name} must be {allowed}, got {number:g}")


def build_dataclass(cls: type[T], table: Any, source: str, prefix: str = "", *, advice: str = "") -> T:
    """A dataclass from a parsed TOML or JSON table. Every key must be known, and every value of the field's type.

    A missing key takes the field's default. For errors: source, where the table comes from; prefix of the keys; advice
    where a key without a default is missing. Raises InputError, which names the key.
    """
    if not isinstance(table, dict):
        raise InputError(f"{source}: {prefix.rstrip('.') or 'it'} must be a table, got {shown(table)}.")
    types = field_types(cls)
    for key in table:
        if key not in types:
            known = f"; known: {', '.join(types)}."
            hint = did_you_mean(f"{prefix}{key}", [f"{prefix}{each}" for each in types], known)
            raise InputError(f"{source}: there is no key {prefix}{key}{hint}")
    values: dict[str, Any] = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        name, kind = field.name, types[field.name]
        if name in table and dataclasses.is_dataclass(kind):
            inner = typing.cast(type, kind)
            values[name] = build_dataclass(inner, table[name], source, f"{prefix}{name}.", advice=advice)
        elif name in table:
            least = min(0, field.metadata.get("limits", {}).get("at_least", 0))
            values[name] = checked(kind, table[name], f"{source}: {prefix}{name}", least)
        elif field.default is dataclasses.MISSING:
            raise InputError(f"{source} lacks the key {prefix}{name}{advice}.")
    try:
        return cls(**values)
    except ValueError as error:
        raise InputError(f"{source}: {prefix}{error}.") from None


def checked(kind: Any, value: Any, where: str, least: float = 0) -> Any:
    """A TOML or JSON value, or a text of the command line, as a value of this type. Raises InputError.

    Numbers must be from `least` to LARGEST_NUMBER, and texts printable.
    """
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value in parts:
            return value
        hint = did_you_mean(value, parts) if isinstance(value, str) else "."
        raise InputError(f"{where} must be {' or '.join(parts)}, got {shown(value)}{hint}")
    if origin is tuple:
        many = parts[-1] is Ellipsis
        if not isinstance(value, list | tuple) or (not many and len(value) != len(parts)):
            raise InputError(f"{where} must be {'a list' if many else f'{len(parts)} numbers'}, got {shown(value)}.")
        kinds = parts[:1] * len(value) if many else parts
        return tuple(checked(part, entry, where, least) for part, entry in zip(kinds, value, strict=True))
    name = _KIND_NAMES.get(kind, "a table")
    if origin is UnionType:
        kind, origin = bool if isinstance(value, bool) or value in ("true", "false") else float, None
    if isinstance(value, str) and kind is bool:
        value = _BOOLEANS.get(value, value)
    elif isinstance(value, str) and kind in (int, float):
        with suppress(ValueError):
            value = kind(value)
    if type(value) is not (origin or kind) and not (kind is float and type(value) is int):
        raise InputError(f"{where} must be {name}, got {shown(value)}.")
    if kind in (int, float) and not least <= value <= LARGEST_NUMBER:
        raise InputError(f"{where} must lie between {least:g} and {LARGEST_NUMBER}, got {shown(value)}.")
    if kind is str and not value.isprintable():
        raise InputError(f"{where} holds {shown(value)}, with characters that cannot be printed.")
    return float(value) if kind is float else value


_BOOLEANS = {"true": True, "false": False}
_KIND_NAMES: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    bool | float: "true, false or a number",
    str: "a text",
}


def field_types(cls: type) -> dict[str, Any]:
    """Field name of a dataclass -> its type."""
    return typing.get_type_hints(cls)


def did_you_mean(name: str, known: Iterable[str], otherwise: str = ".") -> str:
    """The end of a sentence about an unknown name: "; did you mean X?" if a known one is close, or ends with it."""
    known = list(known)
    ending = [each for each in known if each.endswith(f".{name}")]
    close = difflib.get_close_matches(name, ending, n=1, cutoff=0.0) or difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else otherwise
