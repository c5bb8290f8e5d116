"""The scene as a web page: one file with the player (viewer/web), its shaders as data, the scene and a poster."""

import base64
import hashlib
import html
import json
import re
from collections.abc import Iterable
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import encode_jpeg
from lapgs_wgpu.gpu.shader import Defines, browser_source, compose, reflect, struct_layout
from lapgs_wgpu.motion.fields.config import MIN_SCALE
from lapgs_wgpu.splat.drawing import sh_defines
from lapgs_wgpu.splat.raster_config import gpu_config
from lapgs_wgpu.viewer.clock import LOOPS, SPEEDS
from lapgs_wgpu.viewer.controls import KEYS, MOUSE, ORBIT, ZOOM, KeyBinding
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS
from lapgs_wgpu.viewer.viewport import SETTLED, SMALLEST_SCALE, TARGET_SECONDS

# The player's modules, each after those that it imports.
MODULES = (
    "refusal", "lapgs_file", "hash_grid", "scene", "gpu", "scan", "radix_sort", "rasterizer", "hash_encoder",
    "field", "camera", "clock", "presenter", "viewport", "controls", "transport", "api", "main",
)  # fmt: skip
_PLAIN, _SUBGROUPS = gpu_config(0), gpu_config(32)
_SCAN = {"SCAN_LANES": 256}
_HEADS = {"POINTS": 2, "QUADS": 1}
# Name of a pass on the page -> shader and defines: in its shape for GPUs, tables in buffers, 8 storage buffers at most.
PASSES: dict[str, tuple[str, Defines]] = {
    "project": ("project", _PLAIN.tile_defines),
    **{f"color SH {degree}": ("color", sh_defines(degree)) for degree in range(4)},
    "compact": ("compact", {}),
    "duplicate_with_keys": ("duplicate_with_keys", _PLAIN.tile_defines),
    "tile_ranges": ("tile_ranges", {}),
    "rasterize": ("rasterize", _PLAIN.raster_defines(depth=False)),
    "rasterize SUBGROUPS": ("rasterize", _SUBGROUPS.raster_defines(depth=False)),
    **{f"{name}{suffix}": (name, _SCAN | flag) for name in ("scan_reduce", "scan_apply")
       for suffix, flag in (("", {}), (" FLAGS", {"FLAGS": 1}), (" GATHER", {"GATHER": 1}))},
    "rasterize DEPTH": ("rasterize", _PLAIN.raster_defines(depth=True)),
    "sort_count": ("sort_count", {}),
    "sort_scatter": ("sort_scatter", {}),
    "sort_scatter IOTA": ("sort_scatter", {"IOTA": 1}),
    "hashgrid_slice": ("hashgrid_slice", {}),
    "hashgrid SLICED": ("hashgrid", {"SLICED": 1, "CORNERS": 4}),
    "hashgrid": ("hashgrid", {"CORNERS": 8}),
    "deform": ("deform", _HEADS | {"HEADS": 4}),
    "deform MOTION": ("deform", _HEADS | {"HEADS": 4, "MOTION": 1}),
    "deform COLOR MOTION": ("deform", _HEADS | {"HEADS": 5, "MOTION": 1, "COLOR": 1}),
}  # fmt: skip
_DESKTOP_ACTIONS = ("next_mode", "next_view", "toggle_pause", "step_training")


def player_data() -> dict[str, Any]:
    """Collect the data of the player: its passes with their bindings and uniforms, and the viewer's constants."""
    field = ("hashgrid_slice", "hashgrid SLICED", "hashgrid")  # beside one of deform
    chosen = ("color", "rasterize", "deform")  # one of each
    return {
        "kernels": {name: _shader(browser_source(compose(*shape))) for name, shape in PASSES.items()},
        "always": [name for name in PASSES if name not in field and name.split()[0] not in chosen],
        "field": field,
        "tile": [_PLAIN.tile_width, _PLAIN.tile_height],
        "present": _shader(compose("present", {})),
        "minScale": MIN_SCALE,
        "controls": {"keys": {key.key: key.action for key in page_keys()}, "orbit": ORBIT, "zoom": ZOOM},
        "viewport": {"settled": SETTLED, "target": TARGET_SECONDS, "smallest": SMALLEST_SCALE},
        "loops": LOOPS,
        "speeds": SPEEDS,
        "backgrounds": BACKGROUNDS,
    }


def _shader(source: str) -> dict[str, Any]:
    """Describe a shader: number and kind of each binding; size in bytes of each uniform, and offset, type (f or I) and
    length of its members."""
    bindings, uniforms = reflect(source), {}
    for name, binding in bindings.items():
        if binding.kind == "uniform":
            size, members = struct_layout(source, binding.type)
            places = {member: [at, code[-1], int(code[:-1] or 1)] for member, (at, code) in members.items()}
            uniforms[name] = {"size": size, "members": places}
    numbers = {name: [binding.number, binding.kind] for name, binding in bindings.items()}
    return {"source": source, "bindings": numbers, "uniforms": uniforms}


def page_html(scene: bytes, title: str, poster: NDArray[np.uint8], *, narrowest: float = 1.0) -> str:
    """Make the page. scene: a scene.lapgs. poster: (H, W, 3), shown until the first frame, and where WebGPU is missing.
    narrowest: of the scene's first camera (`InitialView`)."""
    edge = "#" + bytes(np.median(poster[0], axis=0).astype(np.uint8)).hex()
    style = web_file("player.css").replace("{{background}}", edge).replace("{{narrowest}}", f"{narrowest:.4g}")
    script = "\n".join(module_script(name) for name in MODULES)  # pages from file:// cannot import others
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
        "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'"
    )
    gestures = [(key.shown, key.help) for key in page_keys()]
    gestures += [*MOUSE, ("two fingers", "move sideways, nearer or farther")]
    values = {
        "policy": policy,
        "title": html.escape(title),
        "style": style,
        "poster": f"data:image/jpeg;base64,{base64.b64encode(encode_jpeg(poster)).decode()}",
        "player": json.dumps(player_data(), separators=(",", ":")).replace("<", "\\u003c"),
        "scene": base64.b64encode(scene).decode(),
        "script": script,
        "help": "".join(f"<dt>{html.escape(shown)}</dt><dd>{html.escape(what)}</dd>" for shown, what in gestures),
        "speeds": _options(f"{speed:g}x" for speed in SPEEDS),
        "loops": _options(LOOPS),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], web_file("player.html"))


def page_keys() -> list[KeyBinding]:
    """The keys of lapgs-view that a page has a use for: it shows no capture and no training."""
    return [key for key in KEYS if key.action not in _DESKTOP_ACTIONS]


def _options(texts: Iterable[str]) -> str:
    return "".join(f"<option>{html.escape(text)}</option>" for text in texts)


def module_script(name: str) -> str:
    """Turn a module of the player into a script: a function of its own, whose exports are the members of `NAME_js`."""
    text = web_file(f"{name}.js")
    exports = re.findall(r"^export (?:async )?(?:function|class|const) (\w+)", text, re.M)
    text = re.sub(r"^import (\{.*\}) from \"\./(\w+)\.js\";", r"const \1 = \2_js;", text, flags=re.M)
    text = re.sub(r"^export ", "", text, flags=re.M)
    return f"const {name}_js = (() => {{\n{text}return {{ {', '.join(exports)} }};\n}})();"


def web_file(name: str) -> str:
    """Read a file of viewer/web."""
    return resources.files("lapgs_wgpu.viewer").joinpath("web", name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
