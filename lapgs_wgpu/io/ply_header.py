"""The header of a PLY file: its elements and their positions in the file.

Files are untrusted: the header's length is limited, and declared sizes are compared with the file size before any
allocation. Only binary little-endian elements with scalar properties are supported, which suffices for Gaussians.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from lapgs_wgpu.errors import InputError

PathLike = str | os.PathLike[str]

MAX_HEADER_BYTES = 64 * 1024

_SCALARS = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip


@dataclass
class Element:
    """An element: `count` rows of `properties` from byte `offset` of the file on."""

    name: str
    count: int
    properties: dict[str, np.dtype[Any]] = field(default_factory=dict)
    comments: list[str] = field(default_factory=list)
    offset: int = 0

    @property
    def stride(self) -> int:
        return sum(dtype.itemsize for dtype in self.properties.values())


@contextmanager
def open_ply(path: PathLike) -> Iterator[tuple[BinaryIO, dict[str, Element]]]:
    """Open a file and read its header. The sizes of the elements add up to the file size. Raises InputError."""
    try:
        mode = os.stat(path).st_mode  # before opening: a pipe would block, a device could be endless
        if stat.S_ISDIR(mode):
            raise InputError(f"{path}: is a folder; give a .ply file, for example the checkpoint.ply in it")
        if not stat.S_ISREG(mode):
            raise InputError(f"{path}: is not a regular file; give a .ply file")
        with open(path, "rb") as file:
            yield file, _read_header(file, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error


def _read_header(file: BinaryIO, path: PathLike) -> dict[str, Element]:
    head = file.read(MAX_HEADER_BYTES)
    size = os.fstat(file.fileno()).st_size
    if head[:64].lstrip().lower().startswith(b"<!doctype html"):
        raise InputError(f"{path}: is a web page, and this is not a browser; give the checkpoint that it was made of")
    if re.match(rb"ply\r?\n", head) is None:
        what = f"begins with {head[:8]!r}" if head else "is empty (0 bytes)"
        raise InputError(f"{path}: {what}, where a PLY file begins with the line 'ply'; give a 3DGS .ply file")
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if end is None:
        raise InputError(
            f"{path}: has no line 'end_header' in its first {len(head)} bytes (at most {MAX_HEADER_BYTES} are read): "
            "it is truncated or not a 3DGS .ply file"
        )
    try:
        lines = head[: end.start()].decode().split("\n")[1:-1]
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} of its header is not UTF-8; the file is damaged") from error
    elements = _parse_lines(lines, path)
    return _place(elements, end.end(), size, path)


def _parse_lines(lines: list[str], path: PathLike) -> dict[str, Element]:
    """Parse the header's lines between `ply` and `end_header`."""
    elements: dict[str, Element] = {}
    last: Element | None = None
    encoding: str | None = None
    for number, line in enumerate(lines, start=2):
        where = f"{path}: header line {number}, {line[:80]!r},"
        match line.split():
            case ["comment" | "obj_info", *words]:
                if last is not None:
                    last.comments.append(" ".join(words))
            case ["format", encoding, _]:
                if encoding != "binary_little_endian":
                    raise InputError(
                        f"{where} has another encoding than binary_little_endian, the only one read; convert the file"
                    )
            case ["element", name, count]:
                if name in elements:
                    raise InputError(f"{where} declares an element a second time; the file is damaged")
                if not re.fullmatch("[0-9]{1,18}", count):
                    raise InputError(f"{where} does not declare a count from 0 to 10^18 - 1; the file is damaged")
                last = elements[name] = Element(name, int(count))
            case ["property", "list", *_]:
                raise InputError(f"{where} is a list: that is a mesh, not Gaussians; give a 3DGS .ply file")
            case ["property", kind, name]:
                if last is None or kind not in _SCALARS:
                    what = "stands before any element" if last is None else f"has an unknown type {kind[:40]!r}"
                    raise InputError(f"{where} {what}; the file is damaged")
                if name in last.properties:
                    raise InputError(f"{where} declares a property a second time; the file is damaged")
                last.properties[name] = np.dtype(_SCALARS[kind])
            case _:
                raise InputError(f"{where} is not a line of a PLY header; the file is damaged")
    if encoding is None:
        raise InputError(f"{path}: its header has no line 'format binary_little_endian 1.0'; the file is damaged")
    return elements


def _place(elements: dict[str, Element], start: int, size: int, path: PathLike) -> dict[str, Element]:
    """Set the elements' offsets. The last element must end at the end of the file of `size` bytes."""
    end = start
    for element in elements.values():
        element.offset = end
        end += element.count * element.stride
        if end > size:
            raise InputError(
                f"{path}: element {element.name[:40]!r} ({element.count} rows of {element.stride} bytes) would end at "
                f"byte {end}, but the file has {size} bytes: it is truncated or its header is wrong"
            )
    if end < size:
        raise InputError(
            f"{path}: its header declares {end} bytes, but the file has {size}: a count is wrong or something was "
            "appended"
        )
    return elements
