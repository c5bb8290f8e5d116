"""PLY files: the elements that a header declares, and their values in any of the three encodings.

Files are untrusted: the header's length is limited, and declared sizes are compared with the file size before any
allocation. Elements with lists, such as the faces of a mesh, are passed over.
"""

import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.safe_json_toml import PathLike, open_regular

Floats = NDArray[np.float32]

BAD_SHARE = 0.01  # of all rows: up to it rows with NaN are left out, above it a file is damaged
LFS_POINTER = b"version https://git-lfs"  # begins what a clone without Git LFS holds in place of a file
_OTHERS = {  # what is given in place of a PLY file, by its first bytes in small letters
    LFS_POINTER: "is a pointer of Git LFS in place of the file; fetch it by git lfs pull",
    b"\x1f\x8b": "is packed by gzip; unpack it",
    b"<!doctype html": "is a web page, and this is not a browser; give the checkpoint that it was made of",
}
MAX_HEADER_BYTES = 64 * 1024
SH_C0 = 0.28209479177387814  # the harmonic of degree 0: f_dc * SH_C0 + 0.5 is a color
_TRIPLES = [
    [f"{before}{name}" for name in names]
    for before in ("", "diffuse_", "vertex_", "scalar_", "ambient_", "color_", "cd_")
    for names in (("red", "green", "blue"), "rgb")
]
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_SCALARS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "half": "f2", "float16": "f2",
}  # fmt: skip


@dataclass
class Element:
    """An element: `count` rows of scalar `properties`. has_lists: whether a row also holds lists, of any length.

    offset: byte of the file at which it begins; line after the header in a text file.
    """

    count: int
    properties: dict[str, np.dtype[Any]] = field(default_factory=dict)
    has_lists: bool = False
    offset: int = 0

    @property
    def row(self) -> np.dtype[Any]:
        """The type of a row without lists."""
        return np.dtype(list(self.properties.items()))


class PlyFile(NamedTuple):
    """An opened file. header_bytes: its header's length. elements: by name, those whose place is known. comments: of
    the whole header, in their order."""

    file: BinaryIO
    path: PathLike
    encoding: str
    header_bytes: int
    elements: dict[str, Element]
    comments: list[str]

    def columns(self, element: Element, names: list[str], dtype: type = np.float32) -> NDArray[Any]:
        """(N, len(names)): the named properties of all rows of an element. Raises InputError."""
        if element.count == 0:
            return np.empty((0, len(names)), dtype)
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):  # of lines without numbers
            if self.encoding != "ascii":
                self.file.seek(element.offset)
                rows = np.fromfile(self.file, element.row, element.count)
            else:
                self.file.seek(self.header_bytes)
                row = np.dtype([(name, np.float64) for name in element.properties])
                options: dict[str, Any] = {"comments": None, "ndmin": 1, "encoding": "latin1"}
                try:
                    rows = np.loadtxt(self.file, row, skiprows=element.offset, max_rows=element.count, **options)
                except ValueError as error:
                    raise InputError(f"{self.path}: its lines do not hold the declared numbers ({error}).") from None
            if len(rows) < element.count:
                raise InputError(f"{self.path}: has {len(rows)} of the {element.count} rows declared; it is cut off.")
            # A double beyond float32 becomes infinite, which callers report.
            values: NDArray[Any] = structured_to_unstructured(rows[names], dtype, copy=True)
            return values


@contextmanager
def open_ply(path: PathLike) -> Iterator[PlyFile]:
    """Open a file and read its header. The sizes of the elements add up to the file size. Raises InputError."""
    with open_regular(path) as file:
        head = file.read(MAX_HEADER_BYTES)
        if re.match(rb"ply\r?\n", head) is None:
            ending = Path(path).suffix.lower()
            if ending in (".spz", ".sog", ".splat", ".ksplat", ".lcc"):  # stills
                raise InputError(f"{path}: is a {ending} file, which is not read; splat-transform converts it.")
            otherwise = (
                f"begins with {head[:8]!r} ({len(head)} bytes were read), where a PLY file begins with the line 'ply'; "
                "convert it to .ply, a cloud of points with CloudCompare for example"
            )
            told = (text for begin, text in _OTHERS.items() if head[:32].lower().startswith(begin))
            raise InputError(f"{path}: {next(told, otherwise)}.")
        end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
        if end is None:
            raise InputError(
                f"{path}: has no line 'end_header' in its first {len(head)} bytes (at most {MAX_HEADER_BYTES} are "
                "read): it is truncated or not a .ply file."
            )
        lines = head[: end.start()].decode(errors="replace").split("\n")[1:-1]  # comments may be in any encoding
        encoding, elements = _parse_lines(lines, path)
        comments = [" ".join(line.split()[1:]) for line in lines if line.startswith(("comment", "obj_info"))]
        placed = _place(elements, encoding, end.end(), file, path)
        yield PlyFile(file, path, encoding, end.end(), placed, comments)


def _parse_lines(lines: list[str], path: PathLike) -> tuple[str, dict[str, Element]]:
    """Parse the header's lines between `ply` and `end_header`: the encoding, and the elements in their order."""
    elements: dict[str, Element] = {}
    last: Element | None = None
    encoding = ""
    for number, line in enumerate(lines, start=2):
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", encoding, _] if encoding in _BYTE_ORDERS:
                pass
            case ["element", name, count] if name not in elements and re.fullmatch("[0-9]{1,18}", count):
                last = elements[name] = Element(int(count))
            case ["property", "list", length, kind, _] if last is not None and {length, kind} <= _SCALARS.keys():
                last.has_lists = True
            case ["property", kind, name] if last is not None and kind in _SCALARS and name not in last.properties:
                last.properties[name] = np.dtype(_BYTE_ORDERS.get(encoding, "<") + _SCALARS[kind])
            case _:
                raise InputError(
                    f"{path}: header line {number}, {line[:80]!r}, stands in no PLY header at this place, has an "
                    "unknown encoding, type or count, or repeats a name; write the file again with another program."
                )
    if not encoding:
        raise InputError(f"{path}: its header has no line 'format binary_little_endian 1.0'; the file is damaged.")
    return encoding, elements


def _place(
    elements: dict[str, Element], encoding: str, start: int, file: BinaryIO, path: PathLike
) -> dict[str, Element]:
    """Set the offsets of elements before the first with lists, and return them. Without lists, they fill the file."""
    text, size = encoding == "ascii", os.fstat(file.fileno()).st_size
    end, line = start, 0
    placed: dict[str, Element] = {}
    for name, element in elements.items():
        if element.has_lists:
            if "vertex" in elements.keys() - placed.keys():
                raise InputError(
                    f"{path}: element {name[:40]!r} has lists, which are read neither in vertex nor before it; "
                    "write the file again with another program."
                )
            return placed
        placed[name] = element
        element.offset = line if text else end
        # In text, a value takes a character and the blank or the line's end behind it.
        stride = max(2 * len(element.properties), 1) if text else element.row.itemsize
        end += element.count * stride
        line += element.count
        if end > size + text:  # the last line needs no end
            raise InputError(
                f"{path}: element {name[:40]!r} ({element.count} rows of {stride} bytes) would end at byte "
                f"{end}, but the file has {size} bytes: it is truncated or its header is wrong."
            )
    file.seek(end)
    if not text and file.read(3) not in (b"", b"\n", b"\r\n"):  # some programs append a line's end
        raise InputError(f"{path}: has {size} bytes, its header declares {end}: a count is wrong, or more was added.")
    return placed


# Colors, by the names and in the types of many programs


def read_colors(ply: PlyFile, vertex: Element) -> Floats | None:
    """Read colors (N, 3) in [0, 1], float32; None where no properties are known as colors.

    Integers are of 255, larger ones of 65535; floating-point numbers of 1 where none is far above. Values that are NaN
    become mid-gray.
    """
    names = {name.lower(): name for name in vertex.properties}
    if {"f_dc_0", "f_dc_1", "f_dc_2"} <= set(names):
        values = ply.columns(vertex, [names[f"f_dc_{channel}"] for channel in range(3)]) * np.float32(SH_C0) + 0.5
    elif found := next((triple for triple in _TRIPLES if set(triple) <= set(names)), None):
        chosen = [names[name] for name in found]
        values = ply.columns(vertex, chosen)
        brightest = np.max(values, where=np.isfinite(values), initial=0.0)
        fractions = all(vertex.properties[name].kind == "f" for name in chosen)
        if not (fractions and brightest < 2):  # some are a little above 1
            values /= np.float32(255 if brightest < 256 else 65535)
    else:
        return None
    return np.nan_to_num(values, nan=0.5).clip(0, 1).astype(np.float32, copy=False)
