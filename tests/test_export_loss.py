"""Exports say what they lost, and of which Gaussians."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.scene_files import scene_of_outliers

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.ply import GaussianSnapshot, write_ply
from lapgs_wgpu.motion.playback.playback import playback_of
from lapgs_wgpu.motion.scene_file import SceneFile
from lapgs_wgpu.viewer.cli import view_command
from lapgs_wgpu.viewer.export import export_compact
from lapgs_wgpu.viewer.export_loss import measure
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, load_scene

COUNT = 1000


def save(file: Path, scene: SceneFile) -> Path:
    g = scene.gaussians
    sh = np.concatenate([g["sh_dc"], g["sh_rest"]], axis=1)[:, :1]
    write_ply(file, GaussianSnapshot(g["means"], sh, g["opacity_logits"], g["log_scales"], g["quats"]))
    return file


@pytest.fixture
def scene(device: Device, tmp_path: Path) -> LoadedScene:
    return load_scene(save(tmp_path / "a.ply", scene_of_outliers(COUNT)), lambda: device)


@pytest.mark.parametrize("ending", ["lapgs", "html", "ply"])
def test_every_export_prints_what_it_lost(
    scene: LoadedScene, tmp_path: Path, capsys: pytest.CaptureFixture[str], ending: str
) -> None:
    assert view_command([str(scene.path), "--export", str(tmp_path / f"b.{ending}")]) == 0
    printed = capsys.readouterr()
    found = re.search(r"([\d.]+) dB PSNR against", printed.out)
    assert found
    assert float(found[1]) >= 50
    assert "warning" not in printed.err


CHANGES = {
    "means": (7, "7 of 1,006 Gaussians lie off"),
    "log_scales": (8, "8 of 1,006 Gaussians have another size"),
    "opacity_logits": (100, "99 of 1,006 Gaussians have another opacity"),  # one was as faint before
    "sh_dc": (10, "10 of 1,006 Gaussians have another color"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_the_gaussians_that_differ_are_told(scene: LoadedScene, device: Device, name: str) -> None:
    """A file in which a property of some Gaussians near the focus is another."""
    count, told = CHANGES[name]
    file = scene_of_outliers(COUNT)
    values = file.gaussians[name].copy()
    near = np.argsort(np.linalg.norm(file.gaussians["means"], axis=1) + (np.arange(COUNT + 6) < 4))[:count]
    values[near] += {"means": 0.5, "log_scales": 2.0, "opacity_logits": -12.0, "sh_dc": 9.0}[name]
    loss = measure(scene, playback_of(replace(file, gaussians=file.gaussians | {name: values}), device))
    assert loss.psnr < 40
    assert loss.reason.startswith(told)


def test_what_the_usual_steps_lose_is_stored_in_finer_ones(device: Device, tmp_path: Path) -> None:
    """Long needles, which 8 bits of a quaternion turn aside."""
    file = scene_of_outliers(COUNT, outliers=False)
    sizes = np.tile(np.log([0.4, 1e-5, 1e-5]).astype(np.float32), (COUNT + 6, 1))
    needles = replace(file, gaussians=file.gaussians | {"log_scales": sizes})
    scene = load_scene(save(tmp_path / "a.ply", needles), lambda: device)
    loss = export_compact(scene, tmp_path / "a.lapgs")
    assert loss.psnr >= 45
    written = load_scene(tmp_path / "a.lapgs", lambda: device)
    assert measure(scene, written.playback, np.arange(COUNT + 4)).psnr == loss.psnr
