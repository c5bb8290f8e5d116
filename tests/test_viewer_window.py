"""The desktop window, on a virtual screen, driven by real mouse and key events."""

import dataclasses
import json
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.desktop import Desktop
from helpers.scene_files import CONFIG
from helpers.waiting import PATIENCE
from numpy.typing import NDArray
from synthetic import write_synthetic

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.scene import Scene4D, load
from lapgs_wgpu.train.presets import load_config, write_toml

SIZE = 320
Picture = NDArray[np.int32]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, device: Device) -> Path:
    """A run folder: a moving scene of a few soft Gaussians, and the capture that its config.toml names."""
    folder = tmp_path_factory.mktemp("run")
    data = write_synthetic(folder / "data", size=SIZE, train_views=4, test_views=2)
    dataset = load_dataset(data)
    generator = torch.Generator().manual_seed(0)
    points = 0.5 * torch.randn(400, 3, generator=generator)
    colors = torch.rand(400, 3, generator=generator)
    scales = np.full(400, 0.06)
    scene = Scene4D.from_points(points.numpy(), colors.numpy(), scales, CONFIG, opacity=0.7, device=device)
    assert scene.field is not None
    with torch.no_grad():
        for parameter in scene.field.parameters():
            parameter.copy_(0.4 * torch.randn(*parameter.shape, generator=generator))
    scene.save(folder / "checkpoint.ply", {"view": look(dataset).to_json(), "background": "black"})
    config = load_config("demo", {"data.path": str(data), "data.size": "0"})
    (folder / "config.toml").write_text(write_toml(dataclasses.asdict(config)))
    return folder


def look(dataset: Dataset) -> InitialView:
    return InitialView(dataset.test[0].camera, dataset.focus, dataset.up, 31)


@pytest.fixture
def desktop() -> Iterator[Desktop]:
    with Desktop() as made:
        yield made


def view(desktop: Desktop, file: Path, size: str) -> None:
    command = [sys.executable, "-m", "lapgs_wgpu.viewer.cli", str(file)]
    desktop.start(*command, "--time-slider", "--size", size)


def scene_part(screen: Picture) -> Picture:
    """Where the panels do not reach in a window of 800x600."""
    return screen[120:480, 260:620]


def changed(screen: Picture, before: Picture) -> bool:
    return np.abs(scene_part(screen) - scene_part(before)).mean() > 1


def test_scrub_and_turn(desktop: Desktop, run: Path) -> None:
    view(desktop, run / "checkpoint.ply", "800x600")
    desktop.wait_for(lambda s: scene_part(s).max() > 60 and s[535:590, 20:780].max() > 200, "scene and slider")
    desktop.events("mousemove", 640, 300)  # away from the scene's part, since Qt shows the pointer
    first = desktop.wait_for(lambda s: True, "the pointer elsewhere")

    def grab(screen: Picture) -> float:
        return float(np.argwhere(screen[543, :800, 0] - screen[543, :800, 2] > 100).mean())

    desktop.drag((25, 548), (400, 548))  # faster than frames are drawn: the last place counts
    desktop.wait_for(lambda s: changed(s, first) and abs(grab(s) - 400) < 3, "another time")
    desktop.events("mousemove", 640, 300, "key", "Home")
    desktop.wait_for(lambda s: np.abs(scene_part(s) - scene_part(first)).max() <= 1, "the start again")

    desktop.drag((400, 300), (470, 320))
    desktop.wait_for(lambda s: changed(s, first), "the scene from elsewhere")
    desktop.events("key", "r")
    desktop.wait_for(lambda s: not changed(s, first), "the first camera again")


@pytest.mark.nightly
def test_a_training_is_watched_paused_and_stepped(desktop: Desktop, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    training = desktop.start(
        sys.executable, "-m", "lapgs_wgpu.cli", "demo", "--data", str(run / "data"), "--data.size", "64",
        "--points.count", "300", "--steps", "100000", "--view", "--out", str(out),
    )  # fmt: skip
    first = desktop.wait_for_change(lambda s: s[150:500, 300:700].max() > 20, "the scene")
    desktop.wait_for_change(lambda s: np.abs(s - first)[150:500, 300:700].max() > 3, "the scene after more steps")
    desktop.events("mousemove", 500, 600, "key", "p")
    paused = desktop.wait_for(lambda s: True, "a training at rest")
    log = (out / "log.jsonl").read_text()
    time.sleep(3)
    assert (out / "log.jsonl").read_text() == log
    desktop.events("key", "s")
    desktop.wait_for(lambda s: not np.array_equal(s, paused), "one more step")
    training.send_signal(signal.SIGINT)
    _, errors = training.communicate(timeout=PATIENCE)
    assert training.returncode == 130
    assert "Traceback" not in errors
    done = int(errors.split("stopped after step ")[1].split()[0])
    logged = json.loads(log.splitlines()[-1])["step"] if log else 0
    assert logged <= done <= logged + 52
    assert int(load(out / "checkpoint.ply").metadata["step"]) == done
