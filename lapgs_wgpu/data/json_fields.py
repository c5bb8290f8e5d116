"""Read fields of untrusted JSON files. Each error names the file, the field, and the value found."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import SUFFIXES
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io import safe_json_toml


def read_json(path: Path, needs: str) -> dict[str, Any]:
    """Read a file that holds a JSON object. needs: its expected content, for errors. Raises InputError."""
    data = safe_json_toml.read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold a JSON object with {needs}, got {kind(data)}.")
    return data


def required(data: dict[str, Any], name: str, where: str | Path, hint: str) -> Any:
    """Return a required field. hint: the reason, which ends the error after a comma. Raises InputError."""
    if name not in data:
        raise InputError(f"{where} has no field {name}, {hint}.")
    return data[name]


def number(value: Any, name: str, where: str | Path) -> float:
    """Convert a JSON number to a float; infinity if it exceeds the range, NaN is allowed. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {name} must be made of numbers, got {kind(value)}.")
    try:
        return float(value)
    except OverflowError:  # an integer of more than 308 digits
        return math.inf


def finite(value: Any, name: str, where: str | Path) -> float:
    """Convert a finite JSON number to a float. Raises InputError."""
    got = number(value, name, where)
    if not math.isfinite(got):
        raise InputError(f"{where}: {name} must be a finite number, got {got:g}.")
    return got


def vector(value: Any, length: int, name: str, where: str | Path) -> NDArray[np.float64]:
    """Convert a JSON list to (length,) finite numbers. Raises InputError."""
    if not isinstance(value, list) or len(value) != length:
        raise InputError(f"{where}: {name} must be a list of {length} numbers, got {kind(value)}.")
    return np.array([finite(entry, name, where) for entry in value])


def check_inside(name: str, field: str, where: str | Path) -> None:
    """Raise InputError if the path in a field leaves the capture's folder, on any system.

    Symbolic links are allowed: the owner of the folder created them.
    """
    for system in (PurePosixPath, PureWindowsPath):
        if system(name).anchor or ".." in system(os.path.normpath(name)).parts:
            raise InputError(
                f"{where}: {field} {kind(name)} leads out of the scene's folder; put the file, or a link to it, into "
                "the folder."
            )


def image_path(entry: dict[str, Any], folder: Path, where: str, hint: str, *, suffix: str = "") -> tuple[str, Path]:
    """The file_path of a frame, and the existing file that it names.

    suffix: appended to a name without an image's suffix. where, hint: for errors, as in `required`.
    """
    name = required(entry, "file_path", where, hint)
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: file_path must be the path of an image, got {kind(name)}.")
    check_inside(name, "file_path", where)
    for written in dict.fromkeys((name, name.replace("\\", "/"))):  # as it stands, or as Windows writes it
        file = folder / (written if written.lower().endswith(SUFFIXES) else written + suffix)
        if os.path.isfile(file):  # Path.is_file raises for names that are too long
            return written, file
    raise InputError(absent(folder / name if os.path.isfile(folder / name) else file, f"{where} names it as file_path"))


def absent(file: Path, named: str) -> str:
    """Why there is no image of this name, for an error. named: what names it."""
    if os.path.isfile(file):
        return f"{file} is neither PNG nor JPEG, but {named}; convert it."
    return f"{file} does not exist, but {named}."


def kind(value: Any) -> str:
    """Describe a JSON value in JSON's terms, short enough for an error."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
