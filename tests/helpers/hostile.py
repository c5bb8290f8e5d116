"""Damage to valid files, by what the file is made of: bytes, or a tree of tables, lists and values.

A mutation is drawn by hypothesis as plain numbers and applied by plain functions, so that it shrinks and repeats.
"""

import copy
import json
import os
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from lapgs_wgpu.errors import InputError

T = TypeVar("T")
COUNT = int(os.environ.get("LAPGS_FUZZ", "0"))  # inputs a format; 0: the suite's own few hundred, always the same
TIMES = 1e3  # seconds that an input may take in milliseconds of hypothesis


def fuzzed(count: int = 200) -> Callable[[T], T]:
    """Settings of a test that is fuzzed: `count` inputs, always the same, or LAPGS_FUZZ new ones."""
    return settings(  # type: ignore[return-value]
        max_examples=COUNT or count,
        derandomize=not COUNT,
        database=None,
        deadline=20_000,  # milliseconds: no input may hang
        suppress_health_check=list(HealthCheck),
    )


def refused_or(action: Callable[[], T]) -> T | None:
    """What an action gives; None where it refuses with an InputError of one printable line. Nothing else may come."""
    try:
        return action()
    except InputError as error:
        text = str(error)
        assert text
        assert text.isprintable()
        assert len(text) <= 2100
        return None


# Bytes ---------------------------------------------------------------------------------------------------------------

_CUTS = st.sampled_from([0, 1, 2, 3, 4, 8, 16, 64, 10**7])
_BYTES = st.sampled_from(
    [
        b"",
        b"\0",
        b"\xff" * 8,
        b"\0" * 64,
        b"\x00\x00\xc0\x7f",  # NaN
        b"\x00\x00\x80\x7f",  # infinity
        b"\xff\xff\x7f\x7f",  # the largest float
        b"\x01\x00\x00\x00",  # the smallest
        b"999999999999999999",
        b"-1",
        b"1e999",
        b"\n",
        b"\r",
        b"\x1b]0;title\x07",
        b"../../../../etc/passwd",
        b"\xed\xa0\x80",  # half a surrogate pair
    ]
) | st.binary(max_size=6)
ByteEdits = list[tuple[str, int, int, bytes]]


def byte_edits(words: Sequence[bytes] = (), least: int = 1) -> st.SearchStrategy[ByteEdits]:
    """One to four edits; words: what else may be put in."""
    new = _BYTES | st.sampled_from(list(words)) if words else _BYTES
    kind = st.sampled_from(["flip", "cut", "replace", "insert", "repeat", "truncate"])
    return st.lists(st.tuples(kind, st.integers(0, 2**32), _CUTS, new), min_size=least, max_size=4)


def edit_bytes(data: bytes, edits: ByteEdits, head: int | None = None) -> bytes:
    """Bytes with these edits; every other one lies within the first `head` bytes, where the sizes are declared."""
    for number, (kind, where, length, new) in enumerate(edits):
        end = min(len(data), head) if head and number % 2 == 0 else len(data)
        at = where % (end + 1)
        if kind == "flip" and data:
            at = min(at, len(data) - 1)
            data = data[:at] + bytes([data[at] ^ (1 << (where % 8))]) + data[at + 1 :]
        elif kind == "cut":
            data = data[:at] + data[at + length :]
        elif kind == "replace":
            data = data[:at] + new + data[at + len(new) :]
        elif kind == "insert":
            data = data[:at] + new + data[at:]
        elif kind == "repeat":
            data = data[: at + length] + data[at : at + min(length, 4096)] + data[at + length :]
        elif kind == "truncate":
            data = data[:at]
    return data


# Trees ---------------------------------------------------------------------------------------------------------------


class Raw(str):
    """Text that stands in the file as it is, where the value would stand."""


HOSTILE: list[Any] = [
    None, True, False, 0, 1, -1, 2, 3, 16, 0.5, -0.0, 1e-300, 1e300, float("nan"), float("inf"), -float("inf"),
    2**31, 2**53, 2**63, -(2**63), 10**400, "", "0", "x", "é", "\0", "\n", "\x1b]0;title\x07", "a" * 5000, "\ud800",
    "..", "../../../../../etc/passwd", "/etc/passwd", "/dev/zero", "C:\\x", "~", "|", "__class__", [], [[]], {},
    [1, 2, 3], [1.0] * 16, [None] * 4, {"a": 1}, [[0, 0, 0, 0]] * 4, [[1e308] * 4] * 4,
    Raw("[" * 20_000), Raw("[" * 2000 + "]" * 2000), Raw("[" * 60 + "]" * 60), Raw('{"a":' * 500 + "1" + "}" * 500),
    Raw("9" * 5000), Raw("0x" + "f" * 9000), Raw("1e99999"), Raw("-"), Raw("1979-05-27T07:32:00Z"),
    Raw('"\\ud800"'), Raw("1, 1"), Raw('1, "a": 1, "a": 2'),
]  # fmt: skip
TreeEdits = list[tuple[str, int, Any]]
tree_edits: st.SearchStrategy[TreeEdits] = st.lists(
    st.tuples(
        st.sampled_from(["value", "value", "value", "delete", "repeat", "rename", "swap", "wrap"]),
        st.integers(0, 2**32),
        st.sampled_from(HOSTILE) | st.integers() | st.floats() | st.text(max_size=8),
    ),
    min_size=1,
    max_size=3,
)


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """(container, key) of everything in a tree."""
    found: list[tuple[Any, Any]] = []
    for key, value in list(tree.items()) if isinstance(tree, dict) else enumerate(tree):
        found.append((tree, key))
        if isinstance(value, dict | list):
            found += _places(value)
    return found


def edit_tree(tree: Any, edits: TreeEdits) -> Any:
    """A copy of a table or list with these edits."""
    tree = copy.deepcopy(tree)
    for kind, where, value in edits:
        places = _places(tree)
        if not places:
            break
        holder, key = places[where % len(places)]
        if kind == "value":
            holder[key] = copy.deepcopy(value)
        elif kind == "delete":
            del holder[key]
        elif kind == "repeat" and isinstance(holder, list):
            holder[key:key] = [holder[key]] * 3
        elif kind == "rename" and isinstance(holder, dict):
            holder[value if isinstance(value, str) and not isinstance(value, Raw) else "other"] = holder.pop(key)
        elif kind == "swap":
            other, name = places[(where >> 8) % len(places)]
            one, two = copy.deepcopy(holder[key]), copy.deepcopy(other[name])
            holder[key], other[name] = two, one
        elif kind == "wrap":
            holder[key] = [holder[key]]
    return tree


def json_text(tree: Any) -> bytes:
    """A tree with Raw texts as JSON."""
    raw: list[str] = []

    def mark(value: Any) -> Any:
        if isinstance(value, Raw):
            raw.append(str(value))
            return f"@raw{len(raw) - 1}@"
        if isinstance(value, dict):
            return {key: mark(inner) for key, inner in value.items()}
        return [mark(inner) for inner in value] if isinstance(value, list | tuple) else value

    text = json.dumps(mark(tree))
    for number, part in enumerate(raw):
        text = text.replace(f'"@raw{number}@"', part)
    return text.encode("utf-8", "surrogatepass")


def toml_text(tree: dict[str, Any]) -> bytes:
    """A tree with Raw texts as TOML, as far as that has words for it."""

    def value_text(value: Any) -> str:
        if isinstance(value, Raw):
            return str(value)
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, int):
            return str(value) if abs(value) < 10**30 else hex(value)
        if isinstance(value, float):
            return repr(value)
        if isinstance(value, list | tuple):
            return f"[{', '.join(map(value_text, value))}]"
        if isinstance(value, dict):
            return "{" + ", ".join(f"{key_text(key)} = {value_text(inner)}" for key, inner in value.items()) + "}"
        return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else "null"

    def key_text(key: str) -> str:
        return key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else json.dumps(key)

    lines = [f"{key_text(key)} = {value_text(value)}" for key, value in tree.items() if not isinstance(value, dict)]
    for key, table in tree.items():
        if isinstance(table, dict):
            lines += [f"[{key_text(key)}]", *(f"{key_text(k)} = {value_text(v)}" for k, v in table.items())]
    return "\n".join(lines).encode("utf-8", "surrogatepass")
