"""The C types that wgpu-py asks for, found quickly.

wgpu-py names each type as a text, once ("WGPUBufferDescriptor *"), and cffi hands such a text to its parser behind all
450 type names of wgpu's header: 13 ms each, for 50 texts until a kernel has run and 90 until a window shows something.
Here only the names in the text go before it. This reaches into cffi: where that is built otherwise nothing is changed.
"""

from __future__ import annotations

import re
from typing import Any

_KINDS = ("typedef", "struct", "union", "enum")


def parse_named_types_only(ffi: Any) -> None:
    """Have a cffi.FFI look up the types of its texts quickly."""
    parser: Any = getattr(ffi, "_parser", None)
    if not isinstance(getattr(parser, "_declarations", None), dict) or not hasattr(parser, "parse_type_and_quals"):
        return
    parse = parser.parse_type_and_quals

    def parse_quickly(text: str) -> Any:  # cffi holds a lock around it
        declared = parser._declarations
        names = [f"{kind} {name}" for kind in _KINDS for name in re.findall(r"\w+", text)]
        parser._declarations = {name: declared[name] for name in names if name in declared}
        try:
            return parse(text)
        finally:
            declared.update(parser._declarations)
            parser._declarations = declared

    parser.parse_type_and_quals = parse_quickly
