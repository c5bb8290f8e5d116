"""WGSL preprocessing: imports, conditions, unrolled loops; and reflection of bindings and structs.

Directives, each on a line of its own:
    #import common/frame            the text of shaders/common/frame.wgsl, once
    #ifdef NAME / #ifndef NAME / #else / #endif
    #table N name: type             a read-only array at binding N (f32, u32, or vec2, vec4 of them), read by name_at(i)
    #unroll i COUNT / #end          COUNT copies of the lines between, `$i` or `$(i)` replaced by 0, 1, ...
`$NAME` elsewhere is replaced by the value of the define NAME; upper case for defines, lower case for loop variables.
Loops are unrolled here because naga adds a counter to each loop, which prevents the driver from unrolling it.

A table is a storage buffer or, with the define TEXTURES, a storage texture with rows of TABLE_WIDTH texels: on many
processors, Mesa's software driver reads a texel of four words ten times faster than one word of a buffer
(docs/notes/speed.md).
"""

import functools
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

Defines = Mapping[str, int]

_DIRECTIVE = re.compile(r"^\s*#(\w+)\s*(.*?)\s*$")
_BINDING = re.compile(
    r"@group\(0\)\s*@binding\((\d+)\)\s*var<\s*(uniform|storage)\s*(?:,\s*(read|read_write)\s*)?>\s*(\w+)\s*:\s*([^;]+);"
)
_TEXTURE = re.compile(r"@group\(0\)\s*@binding\((\d+)\)\s*var\s+(\w+)\s*:\s*texture_storage_2d<(\w+),\s*read>;")
_TABLE = re.compile(r"(\d+)\s+(\w+)\s*:\s*(\S+)")
TABLE_WIDTH = 4096
# type -> (texture format, bytes, components of a texel that hold it)
TABLE_TYPES = {
    "f32": ("r32float", 4, ".x"),
    "u32": ("r32uint", 4, ".x"),
    "vec2<f32>": ("rg32float", 8, ".xy"),
    "vec2<u32>": ("rg32uint", 8, ".xy"),
    "vec4<f32>": ("rgba32float", 16, ""),
    "vec4<u32>": ("rgba32uint", 16, ""),
}
_MEMBER = re.compile(r"(\w+)\s*:\s*([\w<>]+)")
# type -> (alignment, size, struct format), by the WGSL specification's layout rules
_LAYOUT = {
    "f32": (4, 4, "f"),
    "u32": (4, 4, "I"),
    "i32": (4, 4, "i"),
    "vec2<f32>": (8, 8, "2f"),
    "vec2<u32>": (8, 8, "2I"),
    "vec3<f32>": (16, 12, "3f"),
    "vec4<f32>": (16, 16, "4f"),
    "vec4<u32>": (16, 16, "4I"),
    "mat4x4<f32>": (16, 64, "16f"),
}


class ShaderError(Exception):
    """Programming error: a shader that cannot be composed, or a dispatch that does not match it."""


@dataclass(frozen=True)
class Binding:
    """One resource of a shader: its number in group 0, its name, kind and WGSL type."""

    number: int
    name: str
    kind: str  # "uniform", "read", "read_write" or "texture"
    type: str  # of a texture its format


@functools.cache
def shader_text(name: str) -> str:
    """Return the text of shaders/<name>.wgsl, or of a file elsewhere, named by its absolute path without the suffix."""
    elsewhere = Path(name + ".wgsl")
    inside = resources.files("lapgs_wgpu.shaders").joinpath(*(name + ".wgsl").split("/"))
    file = elsewhere if elsewhere.is_absolute() else inside
    if not file.is_file():
        raise ShaderError(f"there is no shader file shaders/{name}.wgsl")
    return file.read_text(encoding="utf-8")


def enabled(defines: Defines) -> dict[str, int]:
    """Return the defines that are there: False stands for one that is absent."""
    return {define: int(value) for define, value in defines.items() if value is not False}


def compose(name: str, defines: Defines) -> str:
    """Return the WGSL of shaders/<name>.wgsl with the given defines, complete."""
    defines = enabled(defines)
    imported: set[str] = set()

    def expanded(lines: Iterator[str], file: str, *, unrolled: bool = False) -> list[str]:
        """All lines, or those up to the #end of an #unroll."""
        out: list[str] = []
        conditions: list[bool] = []
        for line in lines:
            directive = _DIRECTIVE.match(line)
            word, argument = directive.groups() if directive else ("", "")
            if word in ("ifdef", "ifndef"):
                conditions.append((argument in defines) == (word == "ifdef"))
            elif word == "else":
                conditions[-1] = not conditions[-1]
            elif word == "endif":
                conditions.pop()
            elif not all(conditions):
                continue
            elif word == "import":
                if argument not in imported:
                    imported.add(argument)
                    out += expanded(iter(shader_text(argument).splitlines()), argument)
            elif word == "table":
                out.append(_table(argument, "TEXTURES" in defines, file))
            elif word == "unroll":
                variable, count = argument.split()
                body = expanded(lines, file, unrolled=True)
                for k in range(int(_substitute(count, defines, file))):
                    out += [re.sub(rf"\$\({variable}\)|\${variable}\b", str(k), text) for text in body]
            elif word == "end" and unrolled:
                unrolled = False
                break
            elif word:
                raise ShaderError(f"shaders/{file}.wgsl: unknown directive #{word}")
            else:
                out.append(_substitute(line, defines, file) if "$" in line else line)
        if conditions or unrolled:
            left_open = "#ifdef without #endif" if conditions else "#unroll without #end"
            raise ShaderError(f"shaders/{file}.wgsl: {left_open}")
        return out

    return "\n".join(expanded(iter(shader_text(name).splitlines()), name)) + "\n"


def _table(argument: str, texture: bool, file: str) -> str:
    parts = _TABLE.fullmatch(argument)
    if parts is None or parts[3] not in TABLE_TYPES:
        raise ShaderError(f"shaders/{file}.wgsl: cannot read #table {argument}")
    number, name, kind = parts.groups()
    declaration, value = f"var<storage, read> {name}: array<{kind}>", f"{name}[i]"
    if texture:
        texel_format, _, components = TABLE_TYPES[kind]
        declaration = f"var {name}: texture_storage_2d<{texel_format}, read>"
        value = f"textureLoad({name}, vec2(i % {TABLE_WIDTH}u, i / {TABLE_WIDTH}u)){components}"
    return f"@group(0) @binding({number}) {declaration};\nfn {name}_at(i: u32) -> {kind} {{ return {value}; }}"


def _substitute(text: str, defines: Defines, file: str) -> str:
    def value(match: re.Match[str]) -> str:
        name = match[1]
        if name.islower():  # a loop variable of an #unroll further out
            return match[0]
        if name not in defines:
            raise ShaderError(f"shaders/{file}.wgsl needs a value for {name}")
        return str(defines[name])

    return re.sub(r"\$(\w+)", value, text)


def browser_source(source: str) -> str:
    """Return composed WGSL as browsers take it.

    It has the extension that wgpu-native enables unasked, and goes without Tint's proof of uniform subgroups, which no
    workgroup of one subgroup needs (RasterConfig).
    """
    if "subgroup" not in re.sub(r"//[^\n]*", "", source):
        return source
    return f"enable subgroups;\ndiagnostic(off, subgroup_uniformity);\n{source}"


def reflect(source: str) -> dict[str, Binding]:
    """Return the bindings of group 0 in composed WGSL, by name."""
    found = {}
    for number, space, access, name, kind in _BINDING.findall(source):
        access = "uniform" if space == "uniform" else access or "read"
        found[name] = Binding(int(number), name, access, "".join(kind.split()))
    for number, name, texel_format in _TEXTURE.findall(source):
        found[name] = Binding(int(number), name, "texture", texel_format)
    return found


def pack(source: str, struct_name: str, values: Mapping[str, object]) -> bytes:
    """Return the bytes of a WGSL struct with these members (matrices column by column)."""
    size, members = struct_layout(source, struct_name)
    if members.keys() != values.keys():
        difference = members.keys() ^ values.keys()
        raise ShaderError(f"struct {struct_name}: members that only one side has: {sorted(difference)}")
    out = bytearray(size)
    for name, (offset, code) in members.items():
        value = values[name]
        numbers = [value] if isinstance(value, (int, float)) else list(value)  # type: ignore[call-overload]
        struct.pack_into("<" + code, out, offset, *numbers)
    return bytes(out)


@functools.cache
def struct_layout(source: str, struct_name: str) -> tuple[int, dict[str, tuple[int, str]]]:
    """Size of a WGSL struct as a uniform, bytes, and by name of each member its offset and struct format.

    Cached, since each training step needs them.
    """
    body = re.search(rf"struct\s+{struct_name}\s*{{(.*?)}}", source, re.S)
    if body is None:
        raise ShaderError(f"no struct {struct_name} in the shader")
    members: dict[str, tuple[int, str]] = {}
    size, largest = 0, 4
    for name, kind in _MEMBER.findall(re.sub(r"//[^\n]*", "", body[1])):
        alignment, length, code = _LAYOUT[kind]
        largest = max(largest, alignment)
        size += -size % alignment
        members[name] = (size, code)
        size += length
    return size + -size % max(16, largest), members  # uniform buffers come in units of 16 bytes
