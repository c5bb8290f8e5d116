"""lapgs-doctor: its checks pass, each sees a broken kernel, and the report gets written."""

import getpass
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from lapgs_wgpu import doctor, doctor_cli
from lapgs_wgpu.doctor import ALLOWED, errors, pixel_alphas, stacked_gaussians
from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.device import Device, adapter_details
from lapgs_wgpu.splat import rasterize
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.rasterizer import Rasterizer

# Check, shader, text of the shader, and what stands there instead.
MISTAKES = [
    (0, "common/gaussian", "dot(u, u) + low_pass", "dot(u, u) + 1.01 * low_pass"),
    (0, "sort_scatter", "payload_at(i);", "payload_at(i ^ 1u);"),
    (0, "scan_apply", "sum += element(i);", "sum += element(i) & 3u;"),
    (1, "project_bwd", "let along_x = jacobian.x *", "let along_x = 1.01 * jacobian.x *"),
]


@pytest.mark.kernels
def test_checks_pass(device: Device) -> None:
    assert all(error <= allowed for error, allowed in zip(errors(device), ALLOWED.values(), strict=True))


@pytest.mark.kernels
@pytest.mark.parametrize(("number", "file", "text", "instead"), MISTAKES, ids=[mistake[1] for mistake in MISTAKES])
def test_checks_see_broken_kernels(
    number: int, file: str, text: str, instead: str, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = shader.shader_text
    assert text in original(file), "the shader has changed: break it in another way"
    broken = original(file).replace(text, instead)
    monkeypatch.setattr(shader, "shader_text", lambda name: broken if name == file else original(name))
    monkeypatch.setattr(device, "kernel_cache", {})
    monkeypatch.setattr(rasterize, "rasterizer_of", Rasterizer)
    assert list(errors(device))[number] > list(ALLOWED.values())[number]


def test_rounding_decides_nothing_in_the_known_image() -> None:
    """Neither whether a pixel is reached, nor whether it is finished."""
    alphas = pixel_alphas(stacked_gaussians()).detach()
    assert (alphas / CONSTANTS["ALPHA_MIN"] - 1).abs().min() > 1e-6
    drawn = torch.where(alphas >= CONSTANTS["ALPHA_MIN"], alphas, 0.0)
    assert (1 - drawn).prod(dim=0).min() > 10 * CONSTANTS["TRANSMITTANCE_MIN"]


def run_doctor(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lapgs_wgpu.doctor_cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)


def test_the_command_reports_on_the_device() -> None:
    done = run_doctor(VK_LOADER_LAYERS_ENABLE="", MESA_VK_DEVICE_SELECT=f"{Path.home()}/drivers/card.json")
    assert done.returncode == 0, done.stdout + done.stderr
    for check in ALLOWED:
        assert f"- {check}: ok" in done.stdout
    adapter = adapter_details()[0]
    assert f"**{adapter.info.name}**" in done.stdout
    assert not adapter.too_small
    assert all(name in done.stdout for name in (*adapter.limits, "torch", "MESA_VK_DEVICE_SELECT=card.json"))
    for private in (str(Path.home()), f"/{getpass.getuser()}"):
        assert private not in done.stdout
    assert socket.gethostname() not in "".join(doctor_cli.system_lines()).split()


def test_no_adapter_is_exit_code_3_after_the_facts() -> None:
    done = run_doctor(VK_DRIVER_FILES=os.devnull, VK_ICD_FILENAMES=os.devnull)
    assert done.returncode == 3
    assert "lapgs-wgpu" in done.stdout
    assert "Adapters (0)" in done.stdout


def test_an_unknown_adapter_is_exit_code_2() -> None:
    done = run_doctor("--device", "no such card")
    assert done.returncode == 2
    assert "'no such card'" in done.stderr


def test_a_failed_check_fails_the_report(
    device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def found(_: Device) -> Iterator[float]:
        yield 0.0
        yield 0.5
        raise ValueError("no\nshader")

    monkeypatch.setattr(doctor, "open_device", lambda name: device)
    monkeypatch.setattr(doctor, "errors", found)
    monkeypatch.setattr(doctor, "ALLOWED", {"exact": 0, "inexact": 1e-5, "refused": 0})
    assert doctor.self_test(None) == 1
    said = capsys.readouterr().out
    assert "- exact: ok" in said
    assert "- inexact: **FAILED**, error 0.5" in said
    assert "- refused: **FAILED**, ValueError: no shader" in said
    assert "1 of 3 checks passed" in said
