"""The benchmark itself, on a scene so small that its times mean nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.scene_files import moving_scene

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.splat.camera import Camera

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
    table = bench("--parts", "raster", "encoder", "decoder", "losses", "step", "shares", "bytes", "--json", file)
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


def test_nothing_is_read_back_before_the_sort(results: dict) -> None:
    """A step waits twice: for the picture and for the gradients."""
    step = raster(results)["torch_traffic"]
    assert step["read_backs_before_sort"] == 0
    assert step["read_backs"] == 2


def test_bytes_of_a_step_are_those_of_its_tensors(results: dict) -> None:
    step, n, pixels = raster(results)["torch_traffic"], 300, 40 * 40
    gaussians, planes = 4 * n * (3 + 4 + 3 + 1 + 3), 4 * 5 * pixels
    constants = 4096  # what the kernels are told besides
    assert gaussians + planes <= step["uploaded_bytes"] <= gaussians + planes + constants
    splats, gradients = 4 * n * 12, 4 * n * (12 + 3 + 4 + 3)
    assert splats + gradients + planes <= step["downloaded_bytes"] <= splats + gradients + planes + constants


def test_the_encoder_agrees_with_its_reference_at_the_sizes_that_are_timed(results: dict) -> None:
    assert results["encoder"]["largest_difference"] < 1e-5


def test_the_decoders_agree(results: dict) -> None:
    assert results["decoder"]["largest_difference"] < 1e-4


def test_the_losses_agree_with_their_references(results: dict) -> None:
    assert results["losses"]["size"] == 40
    assert results["losses"]["difference"] < 1e-4


def test_a_training_step_waits_three_times(results: dict) -> None:
    """For the hash features, for the losses with all gradients of the Gaussians, and for those of the features."""
    step = results["step"]["traffic"]
    assert step["read_backs"] == 3
    assert step["read_backs_before_sort"] == 1


def test_the_parts_of_a_step_add_up(results: dict) -> None:
    shares = {name: time["median"] for name, time in results["shares"].items()}
    step = shares.pop("step")
    assert all(share > 0 for share in shares.values()), shares
    assert sum(shares.values()) == pytest.approx(step, rel=0.01)


@pytest.mark.parametrize("decoder", ["torch", "device"])
def test_the_bytes_of_a_step_add_up_and_each_has_its_purpose(results: dict, decoder: str) -> None:
    crossings = dict(results["bytes"][decoder])
    step = crossings.pop("step")
    for way in ("up", "down"):
        assert sum(one[way] for one in crossings.values()) == step[way]
    tables = crossings["hash tables, and their gradients"]
    assert tables["up"] == tables["down"] == 8 * results["encoder"]["entries"]
    assert ("features, and their gradients" in crossings) == (decoder == "torch")
    assert crossings["all else"]["up"] + crossings["all else"]["down"] < 1024


# Ceilings, and what is counted


def test_the_machine_is_told(results: dict) -> None:
    told = {"adapter", "driver", "processor", "load before", "load afterwards", "lapgs-wgpu", "torch", "wgpu", "python"}
    assert told <= results["machine"].keys()


def test_what_the_rasterizer_has_to_do_is_counted(results: dict) -> None:
    counts = raster(results)["counts"]
    assert counts["gaussians"] == 300
    assert 0 < counts["visible"] <= 300
    assert counts["visible"] <= counts["intersections"]
    assert 0 < counts["drawn"] <= counts["intersections"]
    assert counts["pixels"] == 40 * 40
    assert counts["pairs"] % counts["drawn"] == 0
    work = {shader: one["work"] for shader, one in raster(results)["passes"]["passes"].items()}
    assert work["rasterize"]["exponentials"] == counts["pairs"]
    assert work["rasterize"]["bytes"] > 56 * counts["drawn"]
    assert work["rasterize_bwd"]["operations"] > work["rasterize"]["operations"]
    assert work["project"]["bytes"] == 300 * 96 + 52 * counts["visible"]
    encoder = {shader: one["work"] for shader, one in results["encoder"]["passes"]["passes"].items()}
    assert encoder["hashgrid"]["bytes"] == 300 * 112 * 24 + 8 * corners(results["encoder"]["levels"], 300)


def corners(levels: int, points: int) -> int:
    """All temporal levels of the preset are cut, the 16 of space are not."""
    return points * (16 * 8 + (levels - 16) * 4)


def test_every_counted_pass_stands_beside_its_ceiling(results: dict) -> None:
    for part in (raster(results), results["encoder"]):
        ceilings = part["passes"]["ceilings"]
        assert min(ceilings["copied_bytes"], ceilings["operations"], ceilings["exponentials"]) > 0
        for shader, one in part["passes"]["passes"].items():
            assert one["ceiling"] > 0, shader
            assert one["share"] == pytest.approx(one["ceiling"] / one["milliseconds"]["median"])


@pytest.mark.parametrize("name", ["ceiling_copy", "ceiling_fma", "ceiling_exp"])
def test_a_ceiling_is_really_computed(name: str) -> None:
    """What the kernels leave behind is what their loops say."""
    program = f"""
import sys
sys.path.insert(0, {str(BENCH)!r})
import numpy as np
from ceilings import CHAINS, STEPS, TURNS, CeilingKernels
from lapgs_wgpu import open_device
from lapgs_wgpu.gpu.kernel import Commands
device = open_device()
kernels = CeilingKernels(device, shortest=0.0)
with Commands(device) as commands:
    kernels._dispatches[{name!r}](commands)
got = kernels._target.read()[:64]
chains = np.arange(CHAINS, dtype=np.float32)[None]
if {name!r} == "ceiling_copy":
    expected = kernels._source.read()[:64]
else:
    x = np.arange(64, dtype=np.float32)[:, None] + chains
    x = x if {name!r} == "ceiling_fma" else -x
    for _ in range(STEPS * TURNS):
        x = x * np.float32(0.999) + np.float32(0.001) if {name!r} == "ceiling_fma" else -np.exp2(x)
    expected = x.sum(axis=1) + (0.001 if {name!r} == "ceiling_exp" else 0)
np.testing.assert_allclose(got, expected, rtol=1e-4)
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)


def test_scenes_have_names() -> None:
    done = subprocess.run([sys.executable, BENCH, "--scenes", "50k"], capture_output=True, text=True)
    assert done.returncode == 2
    assert all(words in done.stderr for words in ("GAUSSIANS@WIDTHxHEIGHT", "CHECKPOINT.ply@WIDTHxHEIGHT", "got '50k'"))


def test_the_checkpoint_of_a_training_is_a_scene_too(device: Device, tmp_path: Path) -> None:
    scene = moving_scene(device, count=60)
    camera = Camera.looking_at([0, 0, -4], [0, 0, 0], up=[0, -1, 0], fov_x=0.6, width=80, height=80)
    view = InitialView(camera, np.zeros(3), np.array([0.0, -1.0, 0.0]), frames=3)
    scene.save(tmp_path / "checkpoint.ply", {"view": view.to_json()})
    name = f"{tmp_path / 'checkpoint.ply'}@40x32"
    bench("--parts", "raster", "--json", tmp_path / "bench.json", scene=name)
    counts = json.loads((tmp_path / "bench.json").read_text())["raster"][name]["counts"]
    assert 0 < counts["visible"] <= 60
    arrays = bench("--save-scene", tmp_path / "scene.npz", scene=name) or np.load(tmp_path / "scene.npz")
    assert (int(arrays["width"]), int(arrays["height"]), len(arrays["means"])) == (40, 32, 60)
    np.testing.assert_allclose(arrays["means"], scene.at(0.5).means.numpy(force=True), atol=1e-6)
