"""Read JSON and TOML from untrusted files within bounds on memory and time.

Parsing JSON takes at most 64 times the file size in memory. The TOML parser is slow, so its size limit is low.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Callable
from typing import Any

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.regular_file import PathLike, open_regular

MAX_JSON_BYTES = 64 << 20
MAX_TOML_BYTES = 256 << 10
MAX_DEPTH = 32  # nesting of lists and tables
# tomllib needs quadratic time in the number of parts of a dotted key. Our keys have at most three parts.
_LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*\.[ \t]*){16}""")


def read_json(path: PathLike) -> Any:
    """Read a JSON file. Of duplicate names in an object, the last one counts. Raises InputError."""
    return parse_json(_read_text(path, MAX_JSON_BYTES, "JSON"), str(path))


def parse_json(text: str, where: str) -> Any:
    """Parse JSON text. Raises InputError; its message begins with `where`."""
    return _parsed(json.loads, text, where, "JSON")


def read_toml(path: PathLike) -> dict[str, Any]:
    """Read a TOML file. Raises InputError."""
    text = _read_text(path, MAX_TOML_BYTES, "TOML")
    if _LONG_KEY.search(text):
        raise InputError(f"{path}: cannot be read as TOML: it holds a dotted key of more than 16 parts.")
    return _parsed(tomllib.loads, text, str(path), "TOML")


def _parsed(parse: Callable[[str], Any], text: str, where: str, language: str) -> Any:
    try:
        value = parse(text)
    except ValueError as error:
        raise InputError(f"{where}: cannot be read as {language}: {str(error)[:200]}.") from None
    except RecursionError:
        raise InputError(f"{where}: cannot be read as {language}: it is nested too deeply.") from None
    _check_depth(value, where, language)
    return value


def _read_text(path: PathLike, most: int, language: str) -> str:
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise InputError(f"{path}: cannot be read as {language}: it has {size} bytes, over {most}.")
        data = file.read(size)
    try:
        return data.decode("utf-8-sig" if language == "JSON" else "utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read as {language}: byte {error.start} is not UTF-8.") from None


def _check_depth(value: Any, where: str, language: str) -> None:
    """Reject deep nesting: later code recurses. Raises InputError."""
    level = [value] if isinstance(value, list | dict) else []
    for _ in range(MAX_DEPTH):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, list | dict)
        ]
        if not level:
            return
    raise InputError(f"{where}: cannot be read as {language}: it is nested more than {MAX_DEPTH} deep.")
