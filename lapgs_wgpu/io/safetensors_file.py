"""Read and write named arrays in the safetensors format. Equal content gives equal bytes.

The safetensors package writes its metadata in random order, so two equal models would give different files. This reader
allocates no more memory than the file has bytes, and its errors name the tensor. Format:
https://github.com/huggingface/safetensors#format
"""

import json
import math
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError, shown

Array = NDArray[Any]
Tensors = Mapping[str, Array]

MAX_HEADER_BYTES = 1 << 20
_DTYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1", "U64": "<u8",
    "U32": "<u4", "U16": "<u2", "U8": "|u1", "BOOL": "|b1",
}  # fmt: skip
_NAMES = {np.dtype(code): name for name, code in _DTYPES.items()}
_METADATA = "__metadata__"


def pack_tensors(tensors: Tensors, metadata: Mapping[str, str]) -> list[bytes | memoryview]:
    """Return the consecutive buffers of a safetensors file.

    Tensors are ordered by decreasing item size, then by name, so that each is aligned; metadata is ordered by key.
    Raises InputError if a value is NaN or infinite, and ValueError if the format lacks a dtype.
    """
    header: dict[str, Any] = {_METADATA: dict(sorted(metadata.items()))} if metadata else {}
    buffers: list[bytes | memoryview] = []
    begin = 0
    for name, array in sorted(tensors.items(), key=lambda item: (-item[1].dtype.itemsize, item[0])):
        dtype = array.dtype.newbyteorder("<")
        if dtype not in _NAMES or name == _METADATA:
            raise ValueError(f"tensor {name!r} of type {array.dtype} cannot be stored")
        _check_finite(array, f"tensor {name!r} cannot be stored:")
        header[name] = {"dtype": _NAMES[dtype], "shape": array.shape, "data_offsets": (begin, begin + array.nbytes)}
        buffers.append(np.asarray(array, dtype, order="C").reshape(-1).view(np.uint8).data)
        begin += array.nbytes
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > MAX_HEADER_BYTES:
        raise ValueError(f"the names and metadata take {len(text)} bytes, over the limit of {MAX_HEADER_BYTES}")
    return [len(text).to_bytes(8, "little") + text, *buffers]


def unpack_tensors(file: BinaryIO, size: int, where: str) -> tuple[dict[str, Array], dict[str, str]]:
    """Read tensors and metadata from the next `size` bytes of `file`.

    Allocates `size` bytes, and at most some tens of MB for the header. Raises InputError, whose message begins with
    `where`, if sizes contradict each other or a float is not finite.
    """
    length = int.from_bytes(file.read(8), "little")
    if length > min(size - 8, MAX_HEADER_BYTES):
        raise InputError(
            f"{where}: declares a header of {length} bytes in {size} bytes, of at most {MAX_HEADER_BYTES}; the file is "
            "damaged"
        )
    try:
        header = json.loads(file.read(length).decode(), object_pairs_hook=_unique)
        json.dumps(header, ensure_ascii=False).encode()  # half a surrogate pair could not be printed later
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: its header is not valid JSON ({str(error)[:120]}); the file is damaged") from error
    metadata = header.pop(_METADATA, {}) if isinstance(header, dict) else None
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise InputError(f"{where}: its header is not a table, or {_METADATA} none of texts; the file is damaged")
    rest = size - 8 - length
    entries = sorted((_parse_entry(name, entry, where), name) for name, entry in header.items())
    position = 0
    for ((begin, end), _, _), name in entries:  # before anything is read: they follow one another without a gap
        if begin != position:
            raise InputError(f"{where}: tensor {name[:80]!r} begins at byte {begin}, not {position}; it is damaged")
        position = end
    if position != rest:
        raise InputError(f"{where}: its tensors end at byte {position}, its data at {rest}; the file is damaged")
    tensors: dict[str, Array] = {}
    for (_, shape, code), name in entries:
        array, which = np.empty(shape, _DTYPES[code]), f"{where}: tensor {name[:80]!r}"
        if file.readinto(array.reshape(-1).view(np.uint8)) != array.nbytes:  # type: ignore[attr-defined]  # all have it
            raise InputError(f"{which}: became shorter while it was read")
        _check_finite(array, which)
        tensors[name] = array
    return tensors, metadata


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(table := dict(pairs)) != len(pairs):
        raise ValueError("a name stands twice")
    return table


def _parse_entry(name: str, entry: Any, where: str) -> tuple[tuple[int, int], tuple[int, ...], str]:
    """The bytes (begin, end) after the header, the shape and the dtype that a tensor's entry declares."""
    match entry:
        case {"dtype": str(code), "shape": [*shape], "data_offsets": [int(begin), int(end)]} if (
            code in _DTYPES
            and len(shape) <= 8
            and all(type(size) is int and size >= 0 for size in shape)
            and math.prod(max(size, 1) for size in shape) < 2**53
            and math.prod(shape) * np.dtype(_DTYPES[code]).itemsize == end - begin
        ):
            return (begin, end), tuple(shape), code
    raise InputError(
        f"{where}: tensor {name[:80]!r} is declared as {shown(entry)}, which is no shape of a known dtype with the "
        "data_offsets of as many bytes; the file is damaged"
    )


def _check_finite(array: Array, what: str) -> None:
    if array.dtype.kind == "f" and not (finite := np.isfinite(array)).all():
        bad = np.flatnonzero(~finite)
        raise InputError(
            f"{what} is NaN or infinite in {len(bad)} of {array.size} values, first in value {bad[0]} (counted from "
            "0); the file is damaged or its training diverged"
        )
