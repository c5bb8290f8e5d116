"""The benchmark itself, on a scene so small that its times mean nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly
BENCH = Path(__file__).parents[1] / "benchmarks"
SCENE = "300@40x40"


def bench(*arguments: str | Path, scene: str = SCENE) -> str:
    command = [sys.executable, BENCH, "--scenes", scene, "--repeat", "1", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=300).stdout


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench") / "bench.json"


@pytest.fixture(scope="module")
def results(file: Path) -> dict:
    table = bench("--parts", "raster", "encoder", "losses", "step", "shares", "--json", file)
    for words in (
        "rasterize_bwd",
        "forward + backward",
        "0 of them before the sort",
        "times as fast as the reference;",
        "times as fast on the device;",
        "as fast as the references",
        "at the ceiling",
    ):
        assert words in table
    return json.loads(file.read_text())


def raster(results: dict) -> dict:
    return results["raster"][SCENE]


def test_the_passes_add_up(results: dict) -> None:
    passes = {shader: one["dispatches"] for shader, one in raster(results)["passes"]["passes"].items()}
    assert {"project", "sort_scatter", "rasterize", "rasterize_bwd", "gather_gradients", "project_bwd"} <= passes.keys()
    assert sum(passes.values()) == raster(results)["torch_traffic"]["dispatches"]


def test_bytes_of_a_step_are_those_of_its_tensors(results: dict) -> None:
    step, n, pixels = raster(results)["torch_traffic"], 300, 40 * 40
    gaussians, planes = 4 * n * (3 + 4 + 3 + 1 + 3), 4 * 5 * pixels
    constants = 4096  # what the kernels are told besides
    assert gaussians + planes <= step["uploaded_bytes"] <= gaussians + planes + constants
    splats, gradients = 4 * n * 12, 4 * n * (12 + 3 + 4 + 3)
    assert splats + gradients + planes <= step["downloaded_bytes"] <= splats + gradients + planes + constants


def test_the_parts_of_a_step_add_up(results: dict) -> None:
    shares = {name: time["median"] for name, time in results["shares"].items()}
    step = shares.pop("step")
    assert all(share > 0 for share in shares.values()), shares
    assert sum(shares.values()) == pytest.approx(step, rel=0.01)


# Ceilings, and what is counted


def test_every_counted_pass_stands_beside_its_ceiling(results: dict) -> None:
    for part in (raster(results), results["encoder"]):
        ceilings = part["passes"]["ceilings"]
        assert min(ceilings["copied_bytes"], ceilings["operations"], ceilings["exponentials"]) > 0
        for shader, one in part["passes"]["passes"].items():
            assert one["ceiling"] > 0, shader
            assert one["share"] == pytest.approx(one["ceiling"] / one["milliseconds"]["median"])


def test_scenes_have_names() -> None:
    done = subprocess.run([sys.executable, BENCH, "--scenes", "50k"], capture_output=True, text=True)
    assert done.returncode == 2
    assert all(words in done.stderr for words in ("GAUSSIANS@WIDTHxHEIGHT", "CHECKPOINT.ply@WIDTHxHEIGHT", "got '50k'"))
