"""All shaders, in every shape in which they are composed, in two compilers: naga (wgpu) and Tint (Chromium)."""

import json
import re
from collections.abc import Iterator
from importlib import resources

import pytest
from helpers.browser import CHROMIUM, WEBGPU, Browser
from helpers.shader_shapes import SHAPES, Defines, all_shapes, described

from lapgs_wgpu.gpu.device import _DEFAULT_LIMITS, Device
from lapgs_wgpu.gpu.shader import browser_source, compose, reflect, shader_text

COMPILE = """(async (requiredFeatures, sources) => {
    const adapter = await navigator.gpu.requestAdapter();
    const device = await adapter.requestDevice({ requiredFeatures });
    const failed = [];
    for (const [name, code] of sources) {
        const info = await device.createShaderModule({ code }).getCompilationInfo();
        const errors = info.messages.filter(message => message.type === "error");
        if (errors.length) failed.push(`${name}: line ${errors[0].lineNum}: ${errors[0].message}`);
    }
    return failed;
})"""


def reachable(name: str, seen: set[str]) -> str:
    """The texts of a shader and of what it imports."""
    seen.add(name)
    text = shader_text(name)
    return text + "".join(reachable(part, seen) for part in re.findall(r"#import (\S+)", text) if part not in seen)


def test_every_shader_and_every_condition_has_its_shapes() -> None:
    """Each #ifdef that a shader itself has is taken both ways."""
    folder = resources.files("lapgs_wgpu.shaders")
    assert set(SHAPES) == {file.name[:-5] for file in folder.iterdir() if file.name.endswith(".wgsl")}
    for name, shapes in SHAPES.items():
        for flag in re.findall(r"#ifn?def (\w+)", shader_text(name)):
            assert {flag in defines for defines in shapes} == {True, False}, f"{name}: {flag}"


def test_default_limits_hold_every_shader() -> None:
    """At most 8 storage buffers, where tables are buffers."""
    counts = {}
    for name, defines in all_shapes():
        if "TEXTURES" not in defines:
            bindings = reflect(compose(name, defines)).values()
            counts[described(name, defines)] = sum(binding.kind in ("read", "read_write") for binding in bindings)
    assert max(counts.values()) == _DEFAULT_LIMITS["max-storage-buffers-per-shader-stage"]


def test_arrays_of_a_lane_are_short() -> None:
    """Mesa's software driver sets each word of a private array to zero by an instruction of its own, and takes as long
    as the square of their number to compile them: 2,048 words took 70 s (docs/notes/speed.md)."""
    longest = 0
    for name, defines in all_shapes():
        source = compose(name, defines)
        arrays = re.findall(r"var<private> \w+: array<(?:vec(\d)<\w+>|\w+), (\d+)u?>", source)
        assert len(arrays) == source.count("var<private>"), described(name, defines)
        longest = max([longest, *(int(width or 1) * int(count) for width, count in arrays)])
    assert 0 < longest <= 256


def needs_subgroups(name: str, defines: Defines) -> bool:
    return "SUBGROUPS" in defines or name == "probe_subgroup"


@pytest.mark.kernels
def test_naga_compiles_every_shape(device: Device) -> None:
    for name, defines in all_shapes():
        if needs_subgroups(name, defines) and "subgroup" not in device.features:
            continue
        device.wgpu_device.create_shader_module(label=described(name, defines), code=compose(name, defines))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    folder = tmp_path_factory.mktemp("tint")
    page = folder / "empty.html"
    page.write_text("<!doctype html><title>empty</title>")
    with Browser(folder / "profile", (64, 64), WEBGPU) as window:
        window.open(page.as_uri())
        yield window


def compile_by_tint(browser: Browser, shapes: list[tuple[str, Defines]], *features: str) -> list[str]:
    """What failed, on a device of WebGPU's default limits with these features."""
    sources = [[described(name, defines), browser_source(compose(name, defines))] for name, defines in shapes]
    failed: list[str] = browser.value(f"{COMPILE}({json.dumps(features)}, {json.dumps(sources)})")
    return failed


@pytest.mark.nightly
def test_tint_compiles_every_shape(browser: Browser) -> None:
    shapes = list(all_shapes())
    plain = [shape for shape in shapes if not needs_subgroups(*shape)]
    assert 100 < len(plain) < len(shapes)
    assert compile_by_tint(browser, plain) == []
    assert compile_by_tint(browser, [shape for shape in shapes if needs_subgroups(*shape)], "subgroups") == []


@pytest.mark.nightly
def test_tint_reports_an_error(browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the test above would see of a barrier that not all lanes reach."""
    monkeypatch.setattr(
        "lapgs_wgpu.gpu.shader.shader_text",
        lambda name: (
            """
        @compute @workgroup_size(8) fn main(@builtin(local_invocation_index) lane: u32) {
            if (lane > 3u) { workgroupBarrier(); }
        }
    """
        ),
    )
    (failure,) = compile_by_tint(browser, [("project", {})])
    assert "uniform control flow" in failure
