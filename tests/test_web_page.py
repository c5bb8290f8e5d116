"""The exported page as a file: what it holds, and that it asks for nothing from elsewhere."""

import base64
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from lapgs_wgpu.gpu.shader import compose
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.web_page import MODULES, PASSES, module_script, page_html, player_data

WEB = Path(__file__).parents[1] / "viewer" / "web"
SCRIPTS = {file.stem: file.read_text(encoding="utf-8") for file in WEB.glob("*.js")}


@pytest.fixture(scope="module")
def page() -> str:
    return page_html(b"bytes of a scene", "a <b> & c", np.zeros((4, 6, 3), np.uint8))


def part(page: str, pattern: str) -> str:
    found = re.search(pattern, page, re.S)
    assert found is not None
    return found[1]


def test_it_holds_scene_shaders_and_title(page: str) -> None:
    assert base64.b64decode(part(page, r'id="scene">(.*?)</script>')) == b"bytes of a scene"
    assert "<title>a &lt;b&gt; &amp; c</title>" in page
    data = json.loads(part(page, r'id="player">(.*?)</script>'))
    assert data == json.loads(json.dumps(player_data()))
    for name, (shader, defines) in PASSES.items():
        assert data["kernels"][name]["source"].endswith(compose(shader, defines))


def test_the_poster_is_as_high_as_the_field_of_view() -> None:
    """Of a scene that was filmed upright, in a window that is narrower still, as of a phone."""
    look = InitialView(Camera(np.diag([900.0, 900, 1]), np.eye(4), 540, 960), np.ones(3), np.ones(3), 30)
    assert look.narrowest == 0.5625
    upright = page_html(b"", "walk", np.zeros((4, 6, 3), np.uint8), narrowest=look.narrowest)
    assert "height: min(100%, 100vw / 0.5625)" in upright
    assert "{{" not in part(upright, r"<style>(.*?)</style>")


def test_the_policy_names_the_scripts_own_digest(page: str) -> None:
    policy = part(page, r'Content-Security-Policy" content="(.*?)"')
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'"
    assert rules["connect-src"] == "'self'"
    for name, pattern in (
        ("script-src", r'<script type="module">(.*?)</script>'),
        ("style-src", r"<style>(.*?)</style>"),
    ):
        digest = base64.b64encode(hashlib.sha256(part(page, pattern).encode()).digest()).decode()
        assert rules[name] == f"'sha256-{digest}'"


def test_nothing_comes_from_elsewhere(page: str) -> None:
    without_scene = re.sub(r'(src="data:|id="scene">)[^"<]*', "", page)
    assert not re.search(r"https?:|//\w+\.\w", re.sub(r"(?m)^\s*//.*$", "", without_scene))
    for text in SCRIPTS.values():
        assert not re.search(r"\beval\b|\bFunction\(|innerHTML|outerHTML|insertAdjacentHTML|document\.write", text)


def test_modules_stand_behind_those_that_they_import() -> None:
    assert sorted(MODULES) == sorted(SCRIPTS)
    for number, name in enumerate(MODULES):
        imported = re.findall(r'^import .* from "\./(\w+)\.js";$', SCRIPTS[name], re.M)
        assert SCRIPTS[name].count("import ") == len(imported)
        assert set(imported) <= set(MODULES[:number])
        for names, source in re.findall(r'^import \{(.*)\} from "\./(\w+)\.js";$', SCRIPTS[name], re.M):
            exported = part(module_script(source), r"return \{ ([^}]*) \};\n\}\)\(\);\n?$")
            assert set(names.replace(" ", "").split(",")) <= set(exported.split(", "))
