"""The timing of a capture: its moments, its text, and what scenes and playback make of it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.playback import open_playback
from helpers.trained_scenes import OURS, trained

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import load
from lapgs_wgpu.motion.timing import EVEN, Timing, timing_of_text

LATE = Timing(np.array([0.2, 0.4, 0.8]), np.array([0.1, 0.5, 0.5]))


def test_moments_lie_between_those_of_the_times_around() -> None:
    found = [LATE(t) for t in (0.2, 0.3, 0.4, 0.6, 0.8)]
    assert found == pytest.approx([0.1, 0.3, 0.5, 0.5, 0.5])


def test_outside_of_all_times_the_difference_is_that_of_the_nearest() -> None:
    assert [LATE(t) for t in (0.0, 0.15, 0.9, 1.0)] == pytest.approx([0.0, 0.05, 0.6, 0.7])
    assert Timing(np.array([0.5]), np.array([0.6]))(1.0) == 1.0


def test_without_times_each_is_its_own_moment() -> None:
    assert [EVEN(t) for t in (0.0, 0.3, 1.0)] == [0.0, 0.3, 1.0]
    assert [EVEN(t) for t in (-0.2, 1.2)] == [0.0, 1.0]


def test_nan_is_no_time() -> None:
    with pytest.raises(ValueError, match="NaN"):
        EVEN(float("nan"))


def test_the_text_gives_the_same_bits() -> None:
    random = np.random.default_rng(0)
    timing = Timing(np.sort(random.random(50)), np.sort(random.random(50)))
    again = timing_of_text(timing.to_text())
    assert again.times.tobytes() == timing.times.tobytes()
    assert again.moments.tobytes() == timing.moments.tobytes()


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ([], "no table of times and moments"),
        ({"times": [0.0, 1.0], "moments": [0.5]}, "as many numbers from 0 to 1"),
        ({"times": [0.5, 0.5], "moments": [0.5, 0.6]}, "timing.times must be different"),
        ({"times": [0.5, 0.6], "moments": [0.6, 0.5]}, "never descend"),
        ({"times": [0.5], "moments": [1.5]}, "numbers from 0 to 1"),
        ({"times": [float("nan")], "moments": [0.5]}, "numbers from 0 to 1"),
    ],
)
def test_text_that_is_no_timing_is_refused(table: object, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        timing_of_text(json.dumps(table))


@pytest.mark.parametrize("config", [OURS, FieldConfig(kind="mlp")], ids=["on the device", "in torch"])
def test_a_scene_moves_by_its_timing_and_so_does_its_file(device: Device, tmp_path: Path, config: FieldConfig) -> None:
    scene = trained(device, config, 40)
    expected = scene.at(0.3).means.detach()
    scene.timing = LATE
    assert torch.equal(scene.at(LATE.times[0] + 0.1).means, expected)  # whose moment is 0.3, too
    assert torch.equal(scene.at_field_time(0.3).means, expected)
    scene.timing = Timing(np.array([0.7]), np.array([0.3]))
    assert torch.equal(scene.at(0.7).means, expected)
    scene.save(tmp_path / "scene.ply")
    assert torch.equal(load(tmp_path / "scene.ply", device).at(0.7).means, expected)
    shown = open_playback(tmp_path / "scene.ply", device)
    np.testing.assert_allclose(shown.at(0.7).means.read(), expected.numpy(), rtol=1e-5, atol=1e-5)
    assert not np.allclose(shown.at(0.3).means.read(), expected.numpy(), rtol=1e-5, atol=1e-5)
