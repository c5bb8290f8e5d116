"""Opening a scene to show it: the pictures are those of Scene4D, and torch stays outside where it can."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.playback import open_playback
from helpers.ply_files import columns_of, ply_bytes, random_still
from helpers.still_scenes import CAMERA, KINDS
from helpers.trained_scenes import CONFIGS, OURS, trained

from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.ply import GaussianSnapshot, write_ply
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.playback.playback import DevicePlayback, Playback
from lapgs_wgpu.motion.playback.torch_playback import TorchPlayback
from lapgs_wgpu.motion.scene import Scene4D, load
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import rasterizer_of
from lapgs_wgpu.splat.rasterizer import Rasterizer

TIMES = (0.0, 0.37, 1.0)
ON_DEVICE = {"static", *CONFIGS}


def picture(playback: Playback, t: float, camera: Camera = CAMERA) -> np.ndarray:
    """(height, width, 3), drawn from the buffers as a viewer does."""
    rasterizer = Rasterizer(playback.device)
    while True:
        drawing = rasterizer.draw(playback.at(t), camera, (0.1, 0.2, 0.3))
        if not rasterizer.grow_on_overflow(drawing):
            return drawing.image.read()[:3].transpose(1, 2, 0)


def saved(device: Device, folder: Path, config: FieldConfig, count: int = 300) -> tuple[Scene4D, Path]:
    scene = trained(device, config, count)
    scene.save(folder / "scene.ply", {"scene": "test"})
    return scene, folder / "scene.ply"


@pytest.mark.kernels
@pytest.mark.parametrize("name", KINDS)
def test_it_shows_the_scene(device: Device, tmp_path: Path, name: str) -> None:
    scene, path = saved(device, tmp_path, KINDS[name])
    playback = open_playback(path, device)
    assert isinstance(playback, DevicePlayback if name in ON_DEVICE else TorchPlayback)
    assert (playback.count, playback.at(0.0).sh_degree, playback.moves) == (300, 2, name != "static")
    assert playback.metadata == {"scene": "test"}
    for t in TIMES:
        shown = picture(playback, t)
        drawn = scene.render(CAMERA, t, torch.tensor([0.1, 0.2, 0.3])).image.numpy()
        assert np.ptp(drawn) > 0.3
        # Rounding may add or drop the faint rim of a splat, which is 1/255 of its color.
        assert np.quantile(np.abs(shown - drawn), 0.99) < 2e-4
        assert np.abs(shown - drawn).max() < 1 / 255
        means = scene.at(t).means.detach().numpy()
        np.testing.assert_allclose(playback.at(t).means.read(), means, rtol=1e-4, atol=1e-4)


@pytest.mark.kernels
@pytest.mark.parametrize("name", ["static", "mlp", "grid4d", "laplacian", "color"])
def test_the_still_is_that_of_the_scene(device: Device, tmp_path: Path, name: str) -> None:
    scene, path = saved(device, tmp_path, KINDS[name])
    for t in (0.0, 0.6):
        found, exact = open_playback(path, device).snapshot(t), scene.snapshot(t)
        write_ply(tmp_path / "still.ply", found)
        for part in ("means", "sh", "quats", "log_scales", "opacity_logits"):
            # Logits near their ends magnify float32's rounding of opacities.
            tolerance = 2e-2 if part == "opacity_logits" else 1e-3
            a, b = getattr(found, part), getattr(exact, part)
            if part == "log_scales":  # of scales that are clamped, or nearly
                a, b = np.maximum(a, -6), np.maximum(b, -6)
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=part)


@pytest.mark.parametrize("name", ["mlp", "hidden layers"])
def test_torch_evaluates_what_has_changed_alone(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    _, path = saved(device, tmp_path, KINDS[name])
    playback = open_playback(path, device)
    assert isinstance(playback, TorchPlayback)
    scene, times = playback.scene, []
    at = scene.at
    monkeypatch.setattr(scene, "at", lambda t: (times.append(t), at(t))[1])

    def evaluated(t: float = 0.1) -> bool:
        times.clear()
        shown = contents(playback.at(t))
        for found, expected in zip(shown, contents(TorchPlayback(load(path, device)).at(t)), strict=True):
            np.testing.assert_array_equal(found, expected)
        return times == [t]

    assert [evaluated(t) for t in (0.1, 0.1, 0.2, 0.1)] == [True, False, True, True]
    for parameter in (*scene.parameters.values(), *scene.field.parameters()):
        with torch.no_grad():
            parameter *= 1
        assert [evaluated(), evaluated()] == [True, False]
    for key, parameter in scene.parameters.items():
        scene.parameters[key] = torch.nn.Parameter(parameter.detach())
        assert [evaluated(), evaluated()] == [True, False]
    scene.sh_degree = 1
    playback.at(0.1)
    assert len(times) == 1


@pytest.mark.kernels
def test_a_training_can_be_watched(device: Device) -> None:
    """Parameters, their number and the degree change between calls, and training's own buffers stay as they are."""
    scene = trained(device, OURS, 50)
    playback = TorchPlayback(scene)
    before = picture(playback, 0.4)
    assert np.abs(before - scene.render(CAMERA, 0.4, torch.tensor([0.1, 0.2, 0.3])).image.numpy()).max() < 1e-6
    assert playback.at(0.4).means.buffer is not rasterizer_of(device).pool.array("input means", (50, 3)).buffer
    with torch.no_grad():
        scene.parameters["sh_dc"] += 0.5
    assert np.abs(picture(playback, 0.4) - before).max() > 0.05
    for name, parameter in scene.parameters.items():
        scene.parameters[name] = torch.nn.Parameter(parameter.detach()[:20].clone())
    scene.sh_degree = 3
    now = playback.at(0.4)
    assert (playback.count, len(now), now.sh_degree) == (20, 20, 3)


@pytest.mark.kernels
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_foreign_ply_stands_still(device: Device, tmp_path: Path, degree: int) -> None:
    still = random_still(40, degree)
    (tmp_path / "foreign.ply").write_bytes(ply_bytes(columns_of(still)))
    playback = open_playback(tmp_path / "foreign.ply", device)
    assert isinstance(playback, DevicePlayback)
    assert (playback.moves, playback.count, playback.at(0.0).sh_degree, playback.metadata) == (False, 40, degree, {})
    drawn = load(tmp_path / "foreign.ply", device).render(CAMERA, 0.0, torch.tensor([0.1, 0.2, 0.3])).image.numpy()
    assert np.abs(picture(playback, 0.7) - drawn).max() < 1e-4
    found: GaussianSnapshot = playback.snapshot(0.3)
    np.testing.assert_array_equal(found.means, still.means)
    np.testing.assert_array_equal(found.sh[:, : still.sh.shape[1]], still.sh)
    np.testing.assert_array_equal(found.opacity_logits, still.opacity_logits)


def contents(now: Gaussians[DeviceArray]) -> list[np.ndarray]:
    """As words, so that equal means equal bits."""
    return [values.view(np.uint32) for values in read_all(list(now.arrays().values()))]


SHOW = """
import sys
from lapgs_wgpu.gpu.device import open_device
from lapgs_wgpu.motion.playback.playback import playback_of
from lapgs_wgpu.motion.scene_file import read_scene

playback = playback_of(read_scene(sys.argv[1]), open_device())
playback.at(0.3), playback.at(0.5).means.read(), playback.snapshot(0.2)
print("torch" in sys.modules)
"""


def test_fields_on_the_device_are_played_without_torch(device: Device, tmp_path: Path) -> None:
    _, path = saved(device, tmp_path, OURS)
    done = subprocess.run([sys.executable, "-c", SHOW, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "False\n"
