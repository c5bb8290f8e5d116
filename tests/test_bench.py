"""The benchmark itself, on a scene so small that its times mean nothing."""

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
def results(tmp_path_factory: pytest.TempPathFactory) -> dict:
    file = tmp_path_factory.mktemp("bench") / "bench.json"
    table = bench("--parts", "raster", "encoder", "losses", "step", "shares", "--json", file)
    for words in (
        "rasterize_bwd",
        "forward + backward",
        "0 of them before the sort",
        "times as fast as the reference;",
        "as fast as the references",
        "at the ceiling",
    ):
        assert words in table
    return json.loads(file.read_text())


def test_passes_stand_beside_their_ceilings_and_add_up(results: dict) -> None:
    passes = results["raster"][SCENE]["passes"]["passes"]
    assert {"project", "sort_scatter", "rasterize", "rasterize_bwd", "gather_gradients", "project_bwd"} <= passes.keys()
    for shader, one in passes.items():
        assert one["share"] == pytest.approx(one["ceiling"] / one["milliseconds"]["median"]), shader
    shares = {name: time["median"] for name, time in results["shares"].items()}
    assert shares.pop("step") == pytest.approx(sum(shares.values()), rel=0.01)
