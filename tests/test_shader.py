"""Composing WGSL, reading its bindings, packing its structs: no device needed."""

import re
import struct
from importlib.resources import files

import pytest

from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.shader import Binding, ShaderError, compose, pack, reflect


@pytest.fixture
def wgsl(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Shader files by name, in place of those on disk."""
    texts: dict[str, str] = {}
    monkeypatch.setattr(shader, "shader_text", lambda name: texts[name])
    return texts


def lines(name: str, **defines: int) -> list[str]:
    return [line.strip() for line in compose(name, defines).splitlines() if line.strip()]


# Imports and conditions


def test_each_file_is_imported_once_and_before_its_users(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "#import left\n#import right\n#import left\nmain"
    wgsl["left"] = "#import base\nleft"
    wgsl["right"] = "#import base\nright"
    wgsl["base"] = "base"
    assert lines("main") == ["base", "left", "right", "main"]


def test_an_import_that_is_switched_off_can_still_come_later(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "#ifdef A\n#import base\n#endif\nmiddle\n#import base"
    wgsl["base"] = "base"
    assert lines("main") == ["middle", "base"]
    assert lines("main", A=1) == ["base", "middle"]


def test_nested_conditions(wgsl: dict[str, str]) -> None:
    inner = "#ifdef B\nab\n  #else\na\n  #endif\nafter", "#ifndef B\nnone\n  #else\nb\n  #endif"
    wgsl["main"] = f"#ifdef A\n  {inner[0]}\n#else\n  {inner[1]}\n#endif\nend"
    assert lines("main") == ["none", "end"]
    assert lines("main", A=1) == ["a", "after", "end"]
    assert lines("main", B=1) == ["b", "end"]
    assert lines("main", A=1, B=1) == ["ab", "after", "end"]


def test_nothing_inside_a_condition_that_fails_is_looked_at(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "#ifdef A\n#import missing\n$MISSING\n#unroll i $MISSING\nx\n#end\n#nonsense\n#endif\nend"
    assert lines("main") == ["end"]


# Loops and values


def test_unrolled_loops(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "#unroll i 3\nf($i, $(i)u, x$i, $i.0);\n#end\nend"
    assert lines("main") == [f"f({k}, {k}u, x{k}, {k}.0);" for k in range(3)] + ["end"]


def test_nested_loops_keep_their_variables_apart(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "#unroll i 2\n#unroll k $N\n$i.$k $(i)$(k)\n#end\n#end"
    assert lines("main", N=2) == ["0.0 00", "0.1 01", "1.0 10", "1.1 11"]
    wgsl["main"] = "#unroll i 1\n#unroll ii 2\n$i $ii\n#end\n#end"
    assert lines("main") == ["0 0", "0 1"]


def test_loops_hold_conditions_and_imports(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "#unroll i 2\n#ifdef A\na$i\n#else\nb$i\n#endif\n#end"
    assert lines("main", A=1) == ["a0", "a1"]
    assert lines("main") == ["b0", "b1"]


def test_defines_are_put_in(wgsl: dict[str, str]) -> None:
    wgsl["main"] = "const A = $WIDTH * $WIDTH_2;"
    assert lines("main", WIDTH=8, WIDTH_2=64) == ["const A = 8 * 64;"]


# Mistakes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#inport base", r"shaders/main\.wgsl: unknown directive #inport"),
        ("a = $WIDTH;", r"shaders/main\.wgsl needs a value for WIDTH"),
        ("#unroll i $COUNT\n#end", r"shaders/main\.wgsl needs a value for COUNT"),
        ("#unroll i 2\nx", r"shaders/main\.wgsl: #unroll without #end"),
        ("#ifdef A\nx", r"shaders/main\.wgsl: #ifdef without #endif"),
        ("#table 0 values: f16", r"shaders/main\.wgsl: cannot read #table 0 values: f16"),
        ("#table values: f32", r"shaders/main\.wgsl: cannot read #table values: f32"),
    ],
)
def test_mistakes_are_named_with_their_file(wgsl: dict[str, str], text: str, message: str) -> None:
    wgsl["main"] = text
    with pytest.raises(ShaderError, match=message):
        compose("main", {})


def test_a_mistake_in_an_imported_file_is_named_with_that_file(wgsl: dict[str, str]) -> None:
    wgsl["main"], wgsl["common/base"] = "#import common/base", "$WIDTH"
    with pytest.raises(ShaderError, match=r"shaders/common/base\.wgsl needs a value for WIDTH"):
        compose("main", {})


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ShaderError, match=r"there is no shader file shaders/common/no_such\.wgsl"):
        compose("common/no_such", {})


# Tables and bindings


@pytest.mark.parametrize(
    ("kind", "texel", "components"),
    [
        ("f32", "r32float", ".x"),
        ("u32", "r32uint", ".x"),
        ("vec2<f32>", "rg32float", ".xy"),
        ("vec4<u32>", "rgba32uint", ""),
    ],
)
def test_a_table_is_a_buffer_or_a_texture(wgsl: dict[str, str], kind: str, texel: str, components: str) -> None:
    wgsl["main"] = f"#table 3 values: {kind}"
    as_buffer, as_texture = compose("main", {}), compose("main", {"TEXTURES": 1})
    assert reflect(as_buffer) == {"values": Binding(3, "values", "read", f"array<{kind}>")}
    assert reflect(as_texture) == {"values": Binding(3, "values", "texture", texel)}
    for text in (as_buffer, as_texture):
        assert f"fn values_at(i: u32) -> {kind}" in text
    assert f"vec2(i % 4096u, i / 4096u)){components};" in as_texture


def test_bindings_are_read_back() -> None:
    source = """
        @group(0) @binding(0) var<uniform> frame: Frame;
        @group(0)  @binding(1) var<storage, read> a: array<f32>;
        @group(0) @binding(2)
            var<storage,read_write> b : array<atomic<u32>, 4>;
        @group(0) @binding(3) var<storage> c: array<vec4<u32>>;   // read-only where nothing is said
        @group(0) @binding(4) var d: texture_storage_2d<rgba32uint, read>;
        var<workgroup> not_bound: array<u32, 8>;
        var<private> nor_this: u32;
    """
    assert reflect(source) == {
        "frame": Binding(0, "frame", "uniform", "Frame"),
        "a": Binding(1, "a", "read", "array<f32>"),
        "b": Binding(2, "b", "read_write", "array<atomic<u32>,4>"),
        "c": Binding(3, "c", "read", "array<vec4<u32>>"),
        "d": Binding(4, "d", "texture", "rgba32uint"),
    }


# Structs


def test_a_scalar_fills_the_gap_behind_a_vec3() -> None:
    source = "struct S { a: vec3<f32>, b: u32, c: vec3<f32>, d: vec3<f32>, e: f32, }"
    packed = pack(source, "S", {"a": (1, 2, 3), "b": 4, "c": (5, 6, 7), "d": (8, 9, 10), "e": 11})
    assert packed == struct.pack("<3fI3f4x3ff", 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11)


def test_alignment_and_rounding() -> None:
    source = "struct S { a: f32, b: vec2<u32>, c: i32, d: vec4<f32>, // x: not a member\n e: u32 }"
    packed = pack(source, "S", {"a": 1, "b": (2, 3), "c": -4, "d": (5, 6, 7, 8), "e": 9})
    assert packed == struct.pack("<f4xIIi12x4fI12x", 1, 2, 3, -4, 5, 6, 7, 8, 9)
    assert len(pack("struct S { a: u32 }", "S", {"a": 1})) == 16


def test_a_matrix_goes_column_by_column_as_given() -> None:
    numbers = list(range(16))
    packed = pack("struct S { a: f32, m: mat4x4<f32> }", "S", {"a": 0.5, "m": numbers})
    assert packed == struct.pack("<f12x16f", 0.5, *numbers)


@pytest.mark.parametrize("values", [{"a": 1}, {"a": 1, "b": 2, "c": 3}])
def test_members_that_only_one_side_has_are_named(values: dict[str, int]) -> None:
    odd = sorted({"a", "b"} ^ set(values))
    with pytest.raises(ShaderError, match=re.escape(f"struct S: members that only one side has: {odd}")):
        pack("struct S { a: u32, b: u32 }", "S", values)
    with pytest.raises(ShaderError, match="no struct T"):
        pack("struct S { a: u32, b: u32 }", "T", values)


# All shaders of the package


@pytest.fixture(scope="module")
def shaders() -> dict[str, str]:
    folder = files("lapgs_wgpu.shaders")
    found = [file for part in (folder, folder / "common") for file in part.iterdir() if file.name.endswith(".wgsl")]
    assert len(found) > 20
    return {file.name: file.read_text(encoding="utf-8") for file in found}


def test_lanes_share_no_vector_that_they_write(shaders: dict[str, str]) -> None:
    """A write to a component of a vector may access the whole vector (WGSL's memory model; Metal's compiler does it).

    Two lanes that write to different components race. Of those that are allowed here, one lane writes to a tile's
    vector, or all write the same value.
    """
    of_buffers = r"var<(?:storage, *read_write|workgroup)> (\w+)"
    found = set()
    for name, text in shaders.items():
        arrays = set(re.findall(of_buffers, text))
        writes = re.findall(r"(\w+)\[[^=;]*\]\.([xyzw])\s*(?:[-+*|&^]?=)(?!=)", text)
        found |= {(name, array, component) for array, component in writes if array in arrays}
    assert found == {
        ("rasterize.wgsl", "ranges", "z"),
        ("rasterize.wgsl", "ranges", "w"),
        ("rasterize_bwd.wgsl", "ranges", "w"),
    }


def test_no_shader_has_float_atomics(shaders: dict[str, str]) -> None:
    """Sums must not depend on the order in which lanes arrive."""
    for text in shaders.values():
        assert not re.search(r"atomic\s*<\s*f", text)
        assert not re.search(r"atomicCompareExchange", text), "a loop of exchanges is a float atomic in disguise"
