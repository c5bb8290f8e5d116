"""A patch that makes cffi look up the C types of wgpu-py faster, which shortens the start.

cffi parses each type name ("WGPUBufferDescriptor *") behind all 450 type names of wgpu's header, which takes 13 ms; 50
names are looked up until the first kernel has run, 90 until a window shows something. With the patch, only the names
in the text are declared before it. It uses cffi's internals; if these differ, nothing is changed.
"""

import re
from typing import Any

_KINDS = ("typedef", "struct", "union", "enum")


def parse_named_types_only(ffi: Any) -> None:
    """Patch a cffi.FFI."""
    parser: Any = getattr(ffi, "_parser", None)
    if not isinstance(getattr(parser, "_declarations", None), dict) or not hasattr(parser, "parse_type_and_quals"):
        return
    parse = parser.parse_type_and_quals

    def parse_quickly(text: str) -> Any:  # called under cffi's lock
        declared = parser._declarations
        names = [f"{kind} {name}" for kind in _KINDS for name in re.findall(r"\w+", text)]
        parser._declarations = {name: declared[name] for name in names if name in declared}
        try:
            return parse(text)
        finally:
            declared.update(parser._declarations)
            parser._declarations = declared

    parser.parse_type_and_quals = parse_quickly
