"""Files of earlier versions open: a checkpoint and a config.toml of commit 55a95a0 (22 November 2026).

old_checkpoint.npz holds the Gaussians that the code of that commit computed from its checkpoint at two times.
"""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.playback import open_playback

from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.scene import load
from lapgs_wgpu.train.presets import config_keys, load_config

DATA = Path(__file__).parent / "data"
CHECKPOINT = DATA / "old_checkpoint.ply"
EXPECTED = np.load(DATA / "old_checkpoint.npz")
NAMES = ("means", "quats", "scales", "opacities", "sh")
TIMES = (0.25, 0.75)


def check(name: str, time: float, found: np.ndarray) -> None:
    expected = EXPECTED[f"{name}_{time}"]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max(), err_msg=name)


@pytest.mark.parametrize("time", TIMES)
def test_training_opens_an_old_checkpoint(device: Device, time: float) -> None:
    scene = load(CHECKPOINT, device)
    with torch.no_grad():
        now = scene.at(time)
    assert (len(scene), scene.sh_degree) == (24, 3)
    for name in NAMES:
        check(name, time, getattr(now, name).numpy())


@pytest.mark.parametrize("time", TIMES)
def test_the_viewer_opens_an_old_checkpoint(device: Device, time: float) -> None:
    playback = open_playback(CHECKPOINT, device)
    now = playback.at(time)
    for name, found in zip(NAMES, read_all([getattr(now, name) for name in NAMES]), strict=True):
        check(name, time, found)


def test_an_old_checkpoint_keeps_what_it_says_of_itself(device: Device) -> None:
    metadata = load(CHECKPOINT, device).metadata
    assert {name: metadata[name] for name in ("scene", "background", "step")} == {
        "scene": "hook",
        "background": "black",
        "step": "60",
    }
    view = InitialView.from_json(metadata["view"])
    assert view is not None
    assert (view.camera.width, view.camera.height, view.frames) == (32, 32, 100)


def test_an_old_config_opens() -> None:
    path = DATA / "old_config.toml"
    config = load_config(str(path))
    table = tomllib.loads(path.read_text())
    for section, keys in table.items():
        if section == "record":
            continue
        for name, value in keys.items() if isinstance(keys, dict) else ():
            if not any(key.startswith(f"{section}.{name}") for key in config_keys()):
                continue
            found = getattr(getattr(config, section), name)
            if isinstance(value, dict):
                found, value = vars(found), {key: tuple(v) if isinstance(v, list) else v for key, v in value.items()}
            assert found == value, f"{section}.{name}"
    assert (config.seed, config.step_place) == (0, "auto")
    # Keys that are younger than the file.
    assert not config.discovery.enabled
    assert config.density.limit == 0
