"""Read fields of untrusted JSON files. Each error names the file, the field, and the value found."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io import safe_json_toml

LARGEST_ENTRY = 1e9  # of a pose: matrix products of larger entries lose all digits
LARGEST_SIDE = 1e5  # of an image, pixels
LARGEST_INTRINSIC = 1e6  # pixels
TINY = 1e-12  # smaller values count as 0
FINITE = -sys.float_info.max, sys.float_info.max  # all numbers that are finite


@dataclass(frozen=True)
class Fields:
    """The fields of a JSON object; others raise InputError. where: file and entry, which begin each error."""

    values: dict[str, Any]
    where: str

    def __post_init__(self) -> None:
        if not isinstance(self.values, dict):
            raise InputError(f"{self.where} must be a JSON object, got {shown(self.values)}.")

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def required(self, name: str) -> Any:
        """Return a field of any type. Raises InputError where it is missing."""
        if name not in self.values:
            raise InputError(f"{self.where} has no field {name}, which this format needs.")
        return self.values[name]

    def number(self, name: str, least: float = -LARGEST_ENTRY, most: float = LARGEST_ENTRY) -> float:
        """Return a number within bounds. Raises InputError."""
        return number(self.required(name), name, self.where, least, most)

    def side(self, name: str) -> int:
        """Return a side of an image in pixels. Raises InputError."""
        return round(self.number(name, 1, LARGEST_SIDE))

    def matrix(self, name: str, *shape: int) -> NDArray[np.float64]:
        """Return a list, or lists in lists, as numbers of this shape, of at most LARGEST_ENTRY. Raises InputError."""
        entries = [self.required(name)]
        for i, length in enumerate(shape):
            if bad := [row for row in entries if not isinstance(row, list) or len(row) != length]:
                needed = " rows of ".join(map(str, shape[i:]))
                raise InputError(f"{self.where}: {name} must be {needed} numbers, got {shown(bad[0])}.")
            entries = [entry for row in entries for entry in row]
        return np.array([number(entry, f"each entry of {name}", self.where) for entry in entries]).reshape(shape)

    def entries(self, name: str, count: int | None = None) -> list[Any]:
        """Return a list of at least one entry, or of `count`. Raises InputError."""
        value = self.required(name)
        if not isinstance(value, list) or not value or (count is not None and len(value) != count):
            needed = "at least one entry" if count is None else f"{count} entries"
            raise InputError(f"{self.where}: {name} must be a list of {needed}, got {shown(value)}.")
        return value

    def objects(self, name: str, what: str) -> "list[Fields]":
        """Return a list of objects. what: an entry, for errors. Raises InputError."""
        return [Fields(value, f"{self.where}, {what} {i}") for i, value in enumerate(self.entries(name))]

    def table(self, what: str, *names: str) -> "list[Fields]":
        """Return the rows of a table that is stored as columns, lists of equal length. what: a row, for errors."""
        first = self.entries(names[0])
        columns = [first, *(self.entries(name, len(first)) for name in names[1:])]
        rows = zip(*columns, strict=True)
        return [Fields(dict(zip(names, row, strict=True)), f"{self.where}, {what} {i}") for i, row in enumerate(rows)]


def read_json(path: Path) -> Fields:
    """Read a file that holds a JSON object. Raises InputError."""
    return Fields(safe_json_toml.read_json(path), str(path))


def number(value: Any, name: str, where: object, least: float = -LARGEST_ENTRY, most: float = LARGEST_ENTRY) -> float:
    """Convert a JSON number, or a text that states one, to a finite float within bounds. Raises InputError."""
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError
        converted = float(value)
    except ValueError:
        raise InputError(f"{where}: {name} must be a number, got {shown(value)}.") from None
    except OverflowError:  # an integer of more than 308 digits
        converted = math.inf
    if not least <= converted <= most:  # true for NaN, too
        raise InputError(f"{where}: {name} must be a finite number from {least:g} to {most:g}, got {converted:g}.")
    return converted
