"""The container of a compact scene, `scene.lapgs`: a deflated safetensors file behind a header of 20 bytes.

docs/format.md has it byte by byte. Browsers unpack it by themselves (DecompressionStream).
"""

import io
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.safe_json_toml import PathLike, open_regular
from lapgs_wgpu.io.safetensors_file import Array, Tensors, pack_tensors, unpack_tensors

MAGIC = b"lapgs4d\n"
VERSION = 2  # 1 has no outliers, and whole numbers alone
MAX_BYTES = 1 << 30  # unpacked: 1.5 million Gaussians with the field of the preset dnerf
_HEADER = struct.Struct("<8sIQ")  # magic, version, bytes once unpacked
_MOST_RATIO = 64  # of unpacked bytes to packed ones: a small file cannot fill the memory of who opens it


def lapgs_bytes(path: PathLike) -> bytes | None:
    """The bytes of a file that begins as a compact scene does, at most some more than MAX_BYTES; None of others."""
    with suppress(InputError), open_regular(path) as file:
        if (begin := file.read(len(MAGIC))) == MAGIC:
            return begin + file.read(MAX_BYTES)
    return None


def pack_lapgs(tensors: Tensors, metadata: Mapping[str, str]) -> bytes:
    """The bytes of a compact scene; equal arguments give equal bytes on every machine with the same zlib. Raises
    InputError where a value is NaN or infinite, or where the reader would refuse the size."""
    content = b"".join(bytes(part) for part in pack_tensors(tensors, metadata))
    if len(content) > MAX_BYTES:
        raise InputError(f"a compact scene holds at most {MAX_BYTES} bytes, and this one needs {len(content)}")
    quantized = [name.removesuffix(".range") for name in tensors if name.endswith(".range")]
    newer = any(f"{name}.outliers" in tensors or tensors[name].dtype.kind == "f" for name in quantized)
    version = VERSION if newer else 1  # version 1 has whole numbers alone; earlier programs read it
    packed = zlib.compress(content, 9)
    if len(content) > _MOST_RATIO * len(packed):  # no repeats then, so that a byte takes a bit or more
        packer = zlib.compressobj(9, strategy=zlib.Z_HUFFMAN_ONLY)
        packed = packer.compress(content) + packer.flush()
    return _HEADER.pack(MAGIC, version, len(content)) + packed


def unpack_lapgs(data: bytes, where: str) -> tuple[dict[str, Array], dict[str, str]]:
    """Tensors and metadata of a compact scene. Memory: twice what it unpacks to, at most MAX_BYTES.

    where: begins the message of an InputError, for data that is damaged or of a later version.
    """
    if len(data) < _HEADER.size or not data.startswith(MAGIC):
        raise InputError(f"{where}: lacks the header of a compact scene ({_HEADER.size} bytes); the file is damaged")
    _, version, size = _HEADER.unpack_from(data)
    packed = len(data) - _HEADER.size
    if not 1 <= version <= VERSION:
        raise InputError(
            f"{where}: has version {version} of the compact scene, and this program reads versions 1 to {VERSION}; "
            "export the scene again, or use the program that wrote it"
        )
    if size > min(MAX_BYTES, _MOST_RATIO * packed):
        raise InputError(
            f"{where}: declares {size} bytes in {packed} packed ones, of at most {MAX_BYTES}, and {_MOST_RATIO} times "
            "the packed ones; the file is damaged"
        )
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(memoryview(data)[_HEADER.size :], size + 1)
    except zlib.error as error:
        raise InputError(f"{where}: cannot be unpacked ({str(error)[:80]}); the file is damaged") from None
    if len(content) != size or not unpacker.eof or unpacker.unused_data:
        raise InputError(f"{where}: its {packed} packed bytes do not hold the {size} declared; the file is damaged")
    return unpack_tensors(io.BytesIO(content), size, where)
