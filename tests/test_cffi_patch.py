"""cffi's types by their text: quick look-ups find the same types."""

import re
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cffi
import pytest

from lapgs_wgpu.gpu.cffi_patch import parse_named_types_only

HEADER = """
typedef unsigned int Flags;
typedef struct BufferImpl *Buffer;
typedef enum { KIND_A = 1, KIND_B = 2 } Kind;
typedef union { int whole; float real; } Word;
typedef struct { Flags flags; Kind kind; Buffer buffer; Word words[4]; } Descriptor;
struct Named { Descriptor first; struct Named *next; };
"""
TEXTS = [
    *("Descriptor *", "Descriptor", "Flags[]", "Buffer[3]", "Buffer const *", "Kind", "Word *", "struct Named *"),
    *("struct Named", "char []", "uint32_t []", "intptr_t", "void *", "struct NotDeclared *"),
    "void(*)(Buffer const *, Kind, Descriptor, void *)",
]


def declared(quick: bool) -> Any:
    ffi = cffi.FFI()
    ffi.cdef(HEADER)
    if quick:
        parse_named_types_only(ffi)
    return ffi


@pytest.mark.parametrize("text", TEXTS)
def test_the_same_types(text: str) -> None:
    quick, usual = declared(True), declared(False)
    for _ in range(2):
        found, expected = (ffi.typeof(text) for ffi in (quick, usual))
        assert (str(found), found.kind) == (str(expected), expected.kind)
        if found.kind in ("struct", "primitive", "enum"):
            assert quick.sizeof(text) == usual.sizeof(text)
    quick.new("Descriptor *", {"flags": 3, "kind": 2, "words": [{"whole": 1}]})


def test_only_what_is_named_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    """In wgpu's own FFI, which is quick once a device was looked for."""
    from wgpu.backends.wgpu_native import ffi

    from lapgs_wgpu.gpu.device import list_devices

    list_devices()
    known: list[int] = []
    parse = ffi._parser._parse
    monkeypatch.setattr(ffi._parser, "_parse", lambda text: known.append(len(ffi._parser._declarations)) or parse(text))
    source = Path(str(resources.files("wgpu") / "backends/wgpu_native/_api.py")).read_text()
    texts = set(re.findall(r'"(WGPU\w+) ?\*"', source))
    assert len(texts) > 30
    for text in texts:
        assert str(ffi.typeof(f"{text}  *")) == f"<ctype '{text} *'>"
    assert known
    assert max(known) <= 2


def test_another_cffi_is_left_alone() -> None:
    other = SimpleNamespace(_parser=SimpleNamespace())
    parse_named_types_only(other)
    assert vars(other._parser) == {}
