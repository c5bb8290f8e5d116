"""Open untrusted files, and read JSON and TOML from them within bounds on memory and time.

Parsing JSON takes at most 64 times the file size in memory. The TOML parser is slow, so its size limit is low.
"""

import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

from lapgs_wgpu.errors import InputError

PathLike = str | os.PathLike[str]
MAX_JSON_BYTES = 64 << 20
MAX_TOML_BYTES = 256 << 10
MAX_DEPTH = 32  # nesting of lists and tables
# tomllib needs quadratic time in the number of parts of a dotted key. Our keys have at most three parts.
_LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*\.[ \t]*){16}""")


@contextmanager
def open_regular(path: PathLike) -> Iterator[BinaryIO]:
    """Open a regular file for reading: no pipe, which would block, and no device, which may never end. Raises
    InputError, also for errors of the file system while it is open."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise InputError(f"{path}: is not a regular file; give the file itself.")
        with open(path, "rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error


def read_json(path: PathLike) -> Any:
    """Read a JSON file. Of duplicate names in an object, the last one counts. Raises InputError."""
    return _parsed(json.loads, _read(path, MAX_JSON_BYTES), str(path), "JSON")


def parse_json(text: str, where: str) -> Any:
    """Parse JSON text. Raises InputError; its message begins with `where`."""
    return _parsed(json.loads, text, where, "JSON")


def read_toml(path: PathLike) -> dict[str, Any]:
    """Read a TOML file. Raises InputError."""
    return _parsed(_toml, _read(path, MAX_TOML_BYTES), str(path), "TOML")


def _toml(data: bytes) -> dict[str, Any]:
    text = data.decode()
    if _LONG_KEY.search(text):
        raise ValueError("it holds a dotted key of more than 16 parts")
    return tomllib.loads(text)


def _read(path: PathLike, most: int) -> bytes:
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise InputError(f"{path}: cannot be read: it has {size} bytes, over {most}.")
        return file.read(size)


def _parsed(parse: Callable[[Any], Any], content: str | bytes, where: str, language: str) -> Any:
    try:
        value = parse(content)
        if _nested_within(value, MAX_DEPTH):
            return value
        reason = f"it is nested more than {MAX_DEPTH} deep"
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]
    raise InputError(f"{where}: cannot be read as {language}: {reason}.")


def _nested_within(value: Any, depth: int) -> bool:
    """Whether lists and tables lie at most `depth` deep in each other: later code recurses."""
    if not isinstance(value, list | dict):
        return True
    inner = value.values() if isinstance(value, dict) else value
    return depth > 0 and all(_nested_within(each, depth - 1) for each in inner)
