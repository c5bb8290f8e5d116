"""Buffers, and kernels that take them by name."""

import struct
import threading
from typing import Any

import numpy as np
import pytest
import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.array import Buffer, BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.shader import ShaderError

pytestmark = pytest.mark.kernels

ADD = """
@group(0) @binding(0) var<storage, read> a: array<u32>;
@group(0) @binding(1) var<storage, read_write> sum: array<u32>;
@compute @workgroup_size(1)
fn main(@builtin(workgroup_id) group: vec3<u32>) { sum[group.x] += a[group.x]; }
"""


@pytest.fixture
def wgsl(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Shader files by name, besides those on disk."""
    texts: dict[str, str] = {"add": ADD}
    on_disk = shader.shader_text
    monkeypatch.setattr(shader, "shader_text", lambda name: texts[name] if name in texts else on_disk(name))
    return texts


def numbers(device: Device, values: Any, label: str = "numbers") -> DeviceArray:
    return DeviceArray.upload(device, label, np.asarray(values, np.uint32))


def add(device: Device) -> Kernel:
    return Kernel(device, "add", {})


# Binding by name


def test_missing_and_unknown_arrays_are_named(device: Device, wgsl: dict[str, str]) -> None:
    a = numbers(device, [1])
    expected = r"shaders/add\.wgsl: arrays that only one side has: \['sum', 'summ'\]"
    with Commands(device) as commands, pytest.raises(ShaderError, match=expected):
        commands.dispatch(add(device), 1, a=a, summ=a)


def test_another_dtype_is_refused(device: Device, wgsl: dict[str, str]) -> None:
    a, floats = numbers(device, [1]), DeviceArray.empty(device, "floats", (4,))
    with Commands(device) as commands, pytest.raises(ShaderError, match="sum holds array<u32>, got float32"):
        commands.dispatch(add(device), 1, a=a, sum=floats)


def test_a_binding_beyond_the_limit_is_refused(device: Device, wgsl: dict[str, str]) -> None:
    a = numbers(device, [1])
    limit = device.max_binding
    part = DeviceArray(a.buffer, (limit // 4 + 4,), "uint32")
    needed = -(-(limit + 16) // 16) * 16  # buffers hold whole vectors
    expected = f"a of the pass add needs {needed} bytes in one binding, but .* allows {limit}"
    with Commands(device) as commands, pytest.raises(MemoryError, match=expected):
        commands.dispatch(add(device), 1, a=part, sum=a)


def test_a_buffer_beyond_the_limit_is_refused(device: Device) -> None:
    limit = device.limits["max-buffer-size"]
    with pytest.raises(MemoryError, match=f"buffer 'huge' needs .* bytes, and one of this device holds {limit}"):
        Buffer(device, limit + 1, "huge")


def test_too_many_storage_buffers_are_counted(device: Device, wgsl: dict[str, str]) -> None:
    declare = "@group(0) @binding({0}) var<storage, read_write> b{0}: array<u32>;\n"
    uses = " + ".join(f"b{i}[0]" for i in range(1, 9))
    body = f"@compute @workgroup_size(1) fn main() {{ b0[0] = {uses}; }}"
    wgsl["many"] = "".join(declare.format(i) for i in range(9)) + body
    with pytest.raises(ShaderError, match=r"(?s)shaders/many\.wgsl does not compile:.* limit is 8, count was 9"):
        Kernel(device, "many", {})


def test_wgsl_that_does_not_compile_is_named(device: Device, wgsl: dict[str, str]) -> None:
    wgsl["broken"] = "@compute @workgroup_size(1) fn main() { let a: u32 = 1.5; }"
    with pytest.raises(ShaderError, match=r"shaders/broken\.wgsl does not compile"):
        Kernel(device, "broken", {})


def test_kernels_are_compiled_once(device: Device) -> None:
    assert Kernel.get(device, "compact") is Kernel.get(device, "compact")
    assert Kernel.get(device, "duplicate_with_keys", TILE_W=8, TILE_H=8) is Kernel.get(
        device, "duplicate_with_keys", TILE_H=8, TILE_W=8
    )
    assert Kernel.get(device, "duplicate_with_keys", TILE_W=8, TILE_H=8) is not Kernel.get(
        device, "duplicate_with_keys", TILE_W=16, TILE_H=8
    )


def test_a_part_of_a_buffer_can_be_bound(device: Device, wgsl: dict[str, str]) -> None:
    a, total = numbers(device, range(200)), numbers(device, [0] * 4)
    with Commands(device) as commands:
        commands.dispatch(add(device), 3, a=a.rows(64, 4), sum=total)
    assert total.read().tolist() == [64, 65, 66, 0]


def test_what_is_bound_follows_a_buffer_that_grew(device: Device, wgsl: dict[str, str]) -> None:
    """Bind groups are kept, but none longer than its buffers, whose memory they hold."""
    kernel, pool, total = add(device), BufferPool(device), numbers(device, [0] * 4)
    for size in range(1, 100):
        a = pool.upload("a", np.full(4 * size, size, np.uint32))
        with Commands(device) as commands:
            commands.dispatch(kernel, 1, a=a, sum=total)
        assert len(kernel._groups) == 1
    assert total.read()[0] == sum(range(1, 100))
    del pool, a
    assert not kernel._groups


def test_uniforms_are_laid_out_as_wgsl_reads_them(device: Device, wgsl: dict[str, str]) -> None:
    wgsl["members"] = """
struct Mixed { a: f32, b: vec2<f32>, c: vec3<f32>, d: u32, e: vec3<f32>, f: mat4x4<f32>, g: vec2<u32>, h: i32 }
@group(0) @binding(0) var<uniform> mixed: Mixed;
@group(0) @binding(1) var<storage, read_write> out: array<f32>;
@compute @workgroup_size(1)
fn main() {
    let m = mixed;
    out[0] = m.a; out[1] = m.b.x; out[2] = m.b.y; out[3] = m.c.x; out[4] = m.c.y; out[5] = m.c.z; out[6] = f32(m.d);
    out[7] = m.e.x; out[8] = m.e.y; out[9] = m.e.z; out[26] = f32(m.g.x); out[27] = f32(m.g.y); out[28] = f32(m.h);
    for (var i = 0u; i < 16u; i++) { out[10u + i] = m.f[i / 4u][i % 4u]; }
}
"""
    kernel = Kernel(device, "members", {})
    packed = kernel.uniform("Mixed", a=0, b=(1, 2), c=(3, 4, 5), d=6, e=(7, 8, 9), f=range(10, 26), g=(26, 27), h=-28)
    out = DeviceArray.empty(device, "out", (29,))
    with Commands(device) as commands:
        commands.dispatch(kernel, 1, mixed=BufferPool(device).constant(packed), out=out)
    assert out.read().tolist() == [*range(28), -28]


# Commands


def test_dispatches_see_what_those_before_them_wrote(device: Device, wgsl: dict[str, str]) -> None:
    a, b = numbers(device, [1, 2, 3, 4]), numbers(device, [0] * 4)
    with Commands(device) as commands:
        for _ in range(10):
            commands.dispatch(add(device), 4, a=a, sum=b)
            commands.dispatch(add(device), 4, a=b, sum=a)
    fibonacci = [0, 1]
    while len(fibonacci) < 22:
        fibonacci.append(fibonacci[-1] + fibonacci[-2])
    assert b.read().tolist() == [fibonacci[20] * k for k in (1, 2, 3, 4)]


def test_a_flush_submits_what_there_is(device: Device, wgsl: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Only where there is a watchdog. What follows sees it, and a later error takes nothing back."""
    kernel = add(device)
    for watchdog, expected in ((True, 6), (False, 5)):
        monkeypatch.setattr(device, "watchdog", watchdog)
        a, b = numbers(device, [1]), numbers(device, [5])

        def fail(a: DeviceArray, b: DeviceArray) -> None:
            with Commands(device) as commands:
                commands.dispatch(kernel, 1, a=a, sum=b)
                commands.flush()
                commands.dispatch(kernel, 1, a=a, sum=b)
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail(a, b)
        assert b.read()[0] == expected
        with Commands(device) as commands:
            commands.flush()
            commands.dispatch(kernel, 1, a=a, sum=b)
            commands.flush()
            commands.dispatch(kernel, 1, a=b, sum=a)
            commands.flush()
        assert (a.read()[0], b.read()[0]) == (expected + 2, expected + 1)


def test_clearing_all_or_the_beginning(device: Device) -> None:
    a, b = numbers(device, range(1, 9)), numbers(device, range(1, 9))
    with Commands(device) as commands:
        commands.clear(a)
        commands.clear(b.rows(0, 3))
    assert a.read().tolist() == [0] * 8
    assert b.read().tolist() == [0, 0, 0, 4, 5, 6, 7, 8]


@pytest.mark.parametrize("groups", [0, 1, 65_536, 131_071])
def test_more_groups_than_one_dimension_holds(device: Device, wgsl: dict[str, str], groups: int) -> None:
    wgsl["visit"] = """
#import common/index
@group(0) @binding(0) var<storage, read_write> visits: array<atomic<u32>>;
@compute @workgroup_size(1)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    atomicAdd(&visits[min(workgroup_number(group, groups), arrayLength(&visits) - 1u)], 1u);
}
"""
    visits = DeviceArray.empty(device, "visits", (131_200,), "uint32")
    with Commands(device) as commands:
        commands.dispatch(Kernel(device, "visit", {}), groups, visits=visits)
    seen = visits.read()
    assert (seen[:groups] == 1).all()
    assert seen[groups:].sum() <= 2  # those that fill the last row


# Tables


@pytest.mark.parametrize("count", [1, 4097, 20_000])
@pytest.mark.parametrize("kind", ["f32", "u32", "vec2<f32>", "vec4<u32>"])
def test_tables_hold_what_the_buffer_holds(device: Device, wgsl: dict[str, str], kind: str, count: int) -> None:
    """Through textures where the device reads tables so: whole rows and a rest, and again after each kind of change."""
    width, scalar = (int(kind[3]) if kind[0] == "v" else 1), "f32" if "f32" in kind else "u32"
    dtype = "float32" if scalar == "f32" else "uint32"
    wgsl["copy"] = f"""
#table 0 source: {kind}
@group(0) @binding(1) var<storage, read_write> target_: array<{kind}>;
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {{
    if (id.x < {count}u) {{ target_[id.x] = source_at(id.x); }}
}}
"""
    wgsl["double"] = f"""
@group(0) @binding(0) var<storage, read_write> target_: array<{scalar}>;
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {{
    if (id.x < {count * width}u) {{ target_[id.x] *= {scalar}(2); }}
}}
"""
    copy = Kernel(device, "copy", {"TEXTURES": 1} if device.textures else {})
    double = Kernel(device, "double", {})
    source, target = (DeviceArray.empty(device, name, (width * count,), dtype) for name in ("source", "target"))
    values = np.random.default_rng(0).integers(0, 1 << 23, width * count).astype(dtype)

    def run(*, change: Kernel | None) -> NDArray[Any]:
        with Commands(device) as commands:
            if change is not None:
                commands.dispatch(change, -(-count * width // 64), target_=source)
            commands.dispatch(copy, -(-count // 64), source=source, target_=target)
        return target.read()

    source.write(values)
    np.testing.assert_array_equal(run(change=None), values)
    np.testing.assert_array_equal(run(change=double), 2 * values)
    source.rows(0, 1).write(values[:1])
    assert run(change=None)[0] == values[0]
    with Commands(device) as commands:
        commands.clear(source)
    np.testing.assert_array_equal(run(change=None), 0 * values)


def test_a_table_whose_copy_was_never_submitted(device: Device, wgsl: dict[str, str]) -> None:
    """Commands that fail leave nothing behind, and no belief that something was done."""
    wgsl["copy"] = """
#table 0 source: u32
@group(0) @binding(1) var<storage, read_write> target_: array<u32>;
@compute @workgroup_size(1)
fn main() { target_[0] = source_at(0u); }
"""
    copy = Kernel(device, "copy", {"TEXTURES": 1} if device.textures else {})
    source, target = numbers(device, [7]), numbers(device, [0])

    def fail() -> None:
        with Commands(device) as commands:
            commands.dispatch(copy, 1, source=source, target_=target)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with Commands(device) as commands:
        commands.dispatch(copy, 1, source=source, target_=target)
    assert target.read()[0] == 7


# Reading and writing


@pytest.mark.parametrize("count", [1, 3, 16_384, 16_385, 100_001])
def test_what_is_written_is_read(device: Device, count: int) -> None:
    values = np.random.default_rng(count).integers(0, 1 << 32, count, dtype=np.uint32)
    buffer = DeviceArray.empty(device, "values", (count,), "uint32")
    assert not buffer.read().any()
    buffer.write(values)
    np.testing.assert_array_equal(buffer.read(), values)
    buffer.write(values[::-1])  # not contiguous
    np.testing.assert_array_equal(buffer.read(), values[::-1])


@pytest.mark.parametrize("count", [1, 3, 17_001])
def test_writing_a_part_leaves_the_rest(device: Device, count: int) -> None:
    before = np.arange(20_000, dtype=np.uint32)
    buffer = numbers(device, before)
    buffer.rows(200, count).write(np.full(count, 7, np.uint32))
    after = buffer.read()
    before[200 : 200 + count] = 7
    np.testing.assert_array_equal(after, before)
    np.testing.assert_array_equal(buffer.rows(198, 15).read(), before[198:213])


def test_types_and_shapes_are_kept(device: Device) -> None:
    values = np.random.default_rng(0).standard_normal((7, 3)).astype(np.float32)
    array = DeviceArray.upload(device, "values", values)
    np.testing.assert_array_equal(array.read(), values)
    array.rows(0, 0).write(np.zeros((0, 3), np.float32))
    assert array.rows(0, 0).read().shape == (0, 3)
    np.testing.assert_array_equal(array.read(), values)
    for wrong in (values.astype(np.float64), values[:6], values.view(np.uint32)):
        with pytest.raises(ValueError, match=r"values: .* is not float32 \(7, 3\)"):
            array.write(wrong)


def test_several_buffers_are_read_at_once(device: Device) -> None:
    a, b = numbers(device, [1, 2, 3, 4, 5]), numbers(device, range(100))
    assert [array.tolist() for array in read_all([b.rows(2, 2), a, b.rows(96, 1)])] == [[2, 3], [1, 2, 3, 4, 5], [96]]


def test_reading_and_writing_beyond_the_end_is_refused(device: Device) -> None:
    buffer = numbers(device, range(4), "short")
    with pytest.raises(ValueError, match="short: 20 bytes do not fit into 16"):
        buffer.buffer.write(np.arange(5, dtype=np.uint32))
    with pytest.raises(ValueError, match="short: 24 bytes do not fit into 16"):
        buffer.buffer.write(np.arange(4, dtype=np.uint32), offset=8)
    with pytest.raises(wgpu.GPUValidationError):
        DeviceArray(buffer.buffer, (5,), "uint32").read()


def test_writes_and_kernels_take_turns(device: Device, wgsl: dict[str, str]) -> None:
    """A write waits for the kernels before it, and a read too."""
    kernel, count = add(device), 20_000
    a, total = numbers(device, np.zeros(count)), numbers(device, np.zeros(count))
    for value in range(5):
        a.write(np.full(count, value, np.uint32))
        with Commands(device) as commands:
            commands.dispatch(kernel, count, a=a, sum=total)
    assert set(total.read().tolist()) == {10}


def test_threads_read_and_write_at_once(device: Device, wgsl: dict[str, str]) -> None:
    """Whichever thread polls, each gets its own answer."""
    kernel, right = add(device), [0, 0]

    def work(which: int) -> None:
        a, total = numbers(device, [which + 1]), numbers(device, [0])
        for turn in range(1, 301):
            with Commands(device) as commands:
                commands.dispatch(kernel, 1, a=a, sum=total)
            right[which] += int(total.read()[0]) == turn * (which + 1)

    threads = [threading.Thread(target=work, args=(which,), daemon=True) for which in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()
    assert right == [300, 300]


# The pool


def test_a_pool_grows_and_keeps(device: Device) -> None:
    pool = BufferPool(device)
    first = pool.array("a", (25,)).buffer
    assert pool.array("a", (50,), "uint8").buffer is first
    assert pool.nbytes == 112
    assert pool.array("a", (10, 25)).buffer is not first
    assert pool.nbytes == 1008


def test_what_varies_is_written_when_it_changes(device: Device) -> None:
    pool = BufferPool(device)

    def varying(content: bytes) -> DeviceArray:
        return pool.varying("n", lambda: content)

    assert varying(struct.pack("<I", 7)).read().view(np.uint32)[0] == 7
    version = varying(struct.pack("<I", 7)).buffer.version
    assert varying(struct.pack("<I", 7)).buffer.version == version
    assert varying(struct.pack("<I", 8)).read().view(np.uint32)[0] == 8
    assert varying(struct.pack("<4I", 8, 2, 3, 4)).read().view(np.uint32).tolist() == [8, 2, 3, 4]
    assert pool.constant(b"12345678") is pool.constant(b"12345678")
