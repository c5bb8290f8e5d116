"""The errors that a user can cause or meet. The commands print their text alone, without a traceback."""

import shlex
import subprocess
import sys
from importlib import import_module
from typing import Any

_MOST = 2000  # characters of a text


class InputError(ValueError):
    """Bad input: a file, a field, an option. The text is one sentence that says what is wrong, where, and what to do.

    Names and values in it come from files of strangers: what is not printable is escaped, so that the text stays on one
    line and no terminal obeys it, and the middle of a very long one is left out. The commands exit with code 2.
    """

    def __init__(self, text: str) -> None:
        if len(text) > _MOST:
            text = f"{text[: _MOST // 2]}...{text[-_MOST // 2 :]}"
        super().__init__("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text))


class NoAdapterError(RuntimeError):
    """No graphics adapter was found (or none of the name asked for). The commands exit with code 3."""


class DeviceError(RuntimeError):
    """The device cannot go on with what it was given. The commands exit with code 4."""


class DeviceMemoryError(DeviceError, MemoryError):
    """A buffer or a binding is too large for the device, or its memory is used up."""


class DeviceLostError(DeviceError):
    """The device is gone: its driver gave up, or it was removed. Nothing on it can be used again."""


class NumericalError(ArithmeticError):
    """A training has values that are not finite, and does not get over it. The commands exit with code 5."""


def shown(value: object) -> str:
    """A value that stands in a stranger's file, as an error shows it."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits, a thousand lists in each other
        text = f"a {type(value).__name__} too large to show"
    return text if len(text) <= 80 else f"{text[:77]}..."


def quoted(path: object) -> str:
    """A path as one word of a command that can be pasted."""
    return subprocess.list2cmdline([str(path)]) if sys.platform == "win32" else shlex.quote(str(path))


def optional_module(name: str, need: str, extra: str) -> Any:
    """Import a module of an extra. need: such as "writing .4dgs needs fourdgs". Raises InputError without it."""
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{need}: {pip_install(extra)}") from None


def pip_install(extra: str) -> str:
    """The command that adds an extra. In double quotes: Windows' cmd.exe knows no others."""
    return f'pip install "lapgs-wgpu[{extra}]"'
