"""The benchmark itself, on a scene so small that its times mean nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCH = Path(__file__).parent / "bench"


def bench(*arguments: str | Path) -> str:
    command = [sys.executable, BENCH, "--gaussians", "300", "--size", "40", "--repeat", "1", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=300).stdout


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict:
    file = tmp_path_factory.mktemp("bench") / "bench.json"
    table = bench("--json", file)
    for words in (
        "rasterize_bwd",
        "forward + backward",
        "0 of them before the sort",
        "times as fast as the twin;",
        "as fast as the twins",
    ):
        assert words in table
    return json.loads(file.read_text())


def test_the_passes_add_up(results: dict) -> None:
    passes = {one["shader"]: one["dispatches"] for one in results["raster"]["passes"]}
    assert {"project", "sort_scatter", "rasterize", "rasterize_bwd", "gather_gradients", "project_bwd"} <= passes.keys()
    assert sum(passes.values()) == results["raster"]["torch_traffic"]["dispatches"]


def test_nothing_is_read_back_before_the_sort(results: dict) -> None:
    """A step waits twice: for the picture and for the gradients."""
    step = results["raster"]["torch_traffic"]
    assert step["read_backs_before_sort"] == 0
    assert step["read_backs"] == 2


def test_bytes_of_a_step_are_those_of_its_tensors(results: dict) -> None:
    step, n, pixels = results["raster"]["torch_traffic"], 300, 40 * 40
    gaussians, planes = 4 * n * (3 + 4 + 3 + 1 + 3), 4 * 5 * pixels
    constants = 4096  # what the kernels are told besides
    assert gaussians + planes <= step["uploaded_bytes"] <= gaussians + planes + constants
    splats, gradients = 4 * n * 12, 4 * n * (12 + 3 + 4 + 3)
    assert splats + gradients + planes <= step["downloaded_bytes"] <= splats + gradients + planes + constants


def test_the_encoder_agrees_with_its_twin_at_the_sizes_that_are_timed(results: dict) -> None:
    assert results["encoder"]["largest_difference"] < 1e-5


def test_the_losses_agree_with_their_twins(results: dict) -> None:
    assert results["losses"]["size"] == 40
    assert results["losses"]["difference"] < 1e-4


def test_a_training_step_waits_three_times(results: dict) -> None:
    """For the hash features, for the losses with all gradients of the Gaussians, and for those of the features."""
    step = results["step"]["traffic"]
    assert step["read_backs"] == 3
    assert step["read_backs_before_sort"] == 1


def test_the_parts_of_a_step_add_up(results: dict) -> None:
    shares = dict(results["shares"])
    step = shares.pop("step")
    assert all(share > 0 for share in shares.values()), shares
    assert sum(shares.values()) == pytest.approx(step, rel=0.01)


def test_the_scene_can_be_saved_for_other_rasterisers(tmp_path: Path) -> None:
    bench("--save-scene", tmp_path / "scene.npz")
    scene = np.load(tmp_path / "scene.npz")
    assert scene["means"].shape == (300, 3)
    assert scene["means"].dtype == np.float32
    assert np.linalg.norm(scene["means"], axis=1).max() <= 1.3
    assert (int(scene["width"]), int(scene["height"])) == (40, 40)
    np.testing.assert_allclose(scene["T_cam_world"] @ [0, 0, -4, 1], [0, 0, 0, 1], atol=1e-6)
