"""The checkpoint: a .ply file that any splat viewer opens as a static scene, with the motion in a further element.

The element `lapgs4d` follows the Gaussians of a 3DGS .ply; its rows of one uint are the bytes of a safetensors file
(docs/format.md). Equal models give equal bytes; nothing in the file is executed.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply import GaussianSnapshot, read_foreign, read_gaussians, write_ply
from lapgs_wgpu.io.ply_elements import PathLike, open_ply
from lapgs_wgpu.io.safetensors_file import Array, Tensors, pack_tensors, unpack_tensors

VERSION = 1
_ELEMENT = "lapgs4d"


class Checkpoint(NamedTuple):
    """still: Gaussians at the reference time. tensors, metadata: the motion. Other 3DGS files have no tensors, and as
    metadata what `read_foreign` finds in them."""

    still: GaussianSnapshot
    tensors: dict[str, Array]
    metadata: dict[str, str]


def write_checkpoint(path: PathLike, still: GaussianSnapshot, tensors: Tensors, metadata: Mapping[str, str]) -> None:
    """Write a checkpoint. Atomic; equal arguments give equal bytes, on every machine.

    tensors: float, int or uint arrays of any shape. Raises InputError when the file cannot be written or a value is
    NaN or infinite.
    """
    try:
        buffers = pack_tensors(tensors, metadata)
    except InputError as error:
        raise InputError(f"{path}: not written, because {error}") from error
    size = sum(map(len, buffers))
    words = -(-size // 4)
    trailer = f"element {_ELEMENT} {words}\ncomment {_ELEMENT} v{VERSION} safetensors {size}\nproperty uint word\n"
    write_ply(path, still, trailer=trailer, buffers=[*buffers, b"\0" * (4 * words - size)])


def read_checkpoint(path: PathLike) -> Checkpoint:
    """Read a checkpoint, or any 3DGS .ply file, which has no tensors. Raises InputError for any other file."""
    with open_ply(path) as ply:
        if _ELEMENT not in ply.elements:
            still, metadata = read_foreign(ply)
            return Checkpoint(still, {}, metadata)
        still = read_gaussians(ply)
        element, where = ply.elements[_ELEMENT], f"{path}: element {_ELEMENT}"
        pattern = rf"^{_ELEMENT} v([0-9]{{1,9}}) safetensors ([0-9]{{1,18}})$"
        declared = re.search(pattern, "\n".join(ply.comments), re.MULTILINE)
        binary = ply.encoding == "binary_little_endian"
        if declared is None or element.properties != {"word": np.dtype("<u4")} or not binary:
            raise InputError(
                f"{where} lacks the line 'comment {_ELEMENT} v{VERSION} safetensors BYTES' or the one binary property "
                "'uint word'; the file is damaged"
            )
        version, size = int(declared[1]), int(declared[2])
        if version != VERSION:
            raise InputError(f"{where} has version {version}; this program reads {VERSION}: use the one that wrote it")
        if not 0 <= 4 * element.count - size < 4:
            raise InputError(f"{where} declares {size} bytes in {element.count} words of 4 bytes; the file is damaged")
        ply.file.seek(element.offset)
        return Checkpoint(still, *unpack_tensors(ply.file, size, where))
