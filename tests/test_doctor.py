"""lapgs-doctor: its checks pass, each sees a broken kernel, and the report gets written whatever a driver does."""

from __future__ import annotations

import getpass
import os
import platform
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from lapgs_wgpu.doctor import checks, report, self_test, system
from lapgs_wgpu.doctor.checks import CHECKS, Check
from lapgs_wgpu.doctor.speed import SPEEDS, measure
from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.device import Device, adapter_details

NAMES = [check.name for check in CHECKS]

# For each check, mistakes in shaders: file, text, and what stands there instead.
BROKEN = {
    "scan": [("scan_apply", "before += element(i);", "before += element(i) & 3u;")],
    "radix sort": [("sort_scatter", "my_counters[d] = place + 1u;", "my_counters[d] = place;"),
                   ("sort_scatter", "ranks[rank] = place + 1u;", "ranks[rank] = place;")],
    "matmul": [("matmul", "fma(vec4(of_a[row + $(i)u])", "fma(vec4(of_a[row])")],
    "image": [("common/gaussian", "dot(u, u) + DILATION", "dot(u, u) + 1.01 * DILATION")],
    "gradient of the image": [("project_bwd", "let along_x = jacobian.x *", "let along_x = 1.01 * jacobian.x *")],
    "hash encoding": [("common/hashgrid", "3.0 - 2.0 *", "3.0 - 2.001 *")],
    "gradient of the hash encoding": [
        ("hashgrid_bwd", "+= cell.weight[$c] * gradient;", "+= 1.01 * cell.weight[$c] * gradient;"),
        ("hashgrid_bwd", "cell.weight[$c] * gradient.x,", "1.01 * cell.weight[$c] * gradient.x,")],
    "image losses": [("loss_gradient", "picture.slope.x * sign(", "1.01 * picture.slope.x * sign(")],
}  # fmt: skip


@pytest.mark.kernels
@pytest.mark.parametrize("check", CHECKS, ids=NAMES)
def test_checks_pass(check: Check, device: Device) -> None:
    assert check.run(device) <= check.allowed


@pytest.mark.kernels
@pytest.mark.parametrize("name", BROKEN)
def test_checks_see_broken_kernels(name: str, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {}
    for file, text, instead in BROKEN[name]:
        texts[file] = texts.get(file, shader.shader_text(file))
        assert text in texts[file], "the shader has changed: break it in another way"
        texts[file] = texts[file].replace(text, instead)
    original = shader.shader_text
    monkeypatch.setattr(shader, "shader_text", lambda file: texts.get(file) or original(file))
    monkeypatch.setattr(device, "kernel_cache", {})
    check = CHECKS[NAMES.index(name)]
    assert check.run(device) > check.allowed


def test_every_check_is_broken_once() -> None:
    assert set(BROKEN) | {"same bits twice"} == set(NAMES)


def test_other_bits_are_seen(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, draw = [], checks.rasterize

    def drifting(*arguments: object, **options: object) -> object:
        rendering = draw(*arguments, **options)  # type: ignore[arg-type]
        drawn.append(rendering)
        return rendering._replace(image=rendering.image * (1 + 1e-6 * len(drawn)))

    monkeypatch.setattr(checks, "rasterize", drifting)
    assert checks.same_bits(device) > 0


@pytest.mark.parametrize("speed", SPEEDS, ids=[speed.name for speed in SPEEDS])
def test_speeds_are_positive(speed: object, device: Device) -> None:
    assert measure(speed, device, 0.0) > 0  # type: ignore[arg-type]


def test_adapters_offer_what_the_kernels_need(device: Device) -> None:
    details = adapter_details()[0]
    assert details.too_small == {}
    assert details.limits["max-storage-buffers-per-shader-stage"] >= 8


# The report


def doctor(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lapgs_wgpu.doctor_cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)


def test_the_command_reports_on_the_device() -> None:
    done = doctor()
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(CHECKS)} of {len(CHECKS)} checks passed" in done.stdout
    for name in (*NAMES, *(speed.name for speed in SPEEDS), adapter_details()[0].info.name):
        assert name in done.stdout


def test_no_adapter_is_exit_code_3_after_the_facts() -> None:
    done = doctor(VK_DRIVER_FILES=os.devnull, VK_ICD_FILENAMES=os.devnull)
    assert done.returncode == 3
    assert "lapgs-wgpu" in done.stdout
    assert "Adapters (0)" in done.stdout
    assert "no Vulkan, Metal or D3D12 adapter was found" in done.stderr


def test_an_unknown_adapter_is_exit_code_2() -> None:
    done = doctor("--device", "no such card")
    assert done.returncode == 2
    assert "no adapter matches --device 'no such card'" in done.stderr


def test_a_crash_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "torch.py").write_text("import os\nos.abort()\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    done = report.Report(None)
    text = "\n".join(done.lines())
    assert "The self-test did not end: the process ended with code -6 at: import of torch" in text
    assert not done.passed


def test_messages_in_other_encodings_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows' paths and drivers' texts come in the language's code page."""
    text = "b'Users\\\\J\\xfcrgen: no such driver\\n'"
    program = f"import os\nos.write(1, {text})\nos.write(2, {text})\nos._exit(5)\n"
    (tmp_path / "torch.py").write_text(program)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (line,) = self_test.self_test(None)
    assert "ended with code 5 at: import of torch" in line["problem"]
    assert "rgen: no such driver" in line["problem"]
    assert self_test._code(0xC0000005) == "0xc0000005"


def test_a_hanging_driver_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "torch.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(self_test, "_HANGING", 5.0)
    assert list(self_test.self_test(None)) == [
        {"kind": "broken", "problem": "no result within 5 s at: import of torch"}
    ]


def test_a_failed_check_fails_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [
        {"kind": "adapter", "name": "Card", "backend": "Vulkan"},
        {"kind": "check", "name": "scan", "error": 0.0, "allowed": 0.0, "seconds": 0.1},
        {"kind": "check", "name": "image", "error": 0.5, "allowed": 1e-5, "seconds": 0.1},
        {"kind": "check", "name": "matmul", "problem": "ShaderError: a | b\nnext line"},
        {"kind": "end", "seconds": 1.0},
    ]
    monkeypatch.setattr(report, "self_test", lambda name: iter(lines))
    done = report.Report(None)
    text = "\n".join(done.lines())
    assert "1 of 3 checks passed" in text
    assert "| image                          | FAILED | 0.5 " in text
    assert "ShaderError: a / b next line" in text
    assert not done.passed


def test_the_report_names_no_user_and_no_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", f"{Path.home()}/drivers/card.json{os.pathsep}/other/second.json")
    facts = system.system_facts()
    assert f"VK_DRIVER_FILES=card.json{os.pathsep}second.json" in facts["environment"]
    text = " ".join(facts.values())
    for private in (str(Path.home()), socket.gethostname(), f"/{getpass.getuser()}"):
        assert private not in text
    assert "missing" not in facts["packages"].split(",")[0]


@pytest.mark.parametrize(
    ("lines", "named"),
    [
        ("processor\t: 0\nBogoMIPS\t: 50.00\nCPU part\t: 0xd0c\n", platform.processor() or platform.machine()),
        ("processor\t: 0\nmodel name\t: Some Processor\n", "Some Processor"),
    ],
    ids=["ARM", "x86"],
)
def test_a_processor_may_have_no_name(lines: str, named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: lines)
    assert system.system_facts()["processor"].startswith(f"{named}, ")
