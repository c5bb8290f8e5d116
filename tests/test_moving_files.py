"""Moving scenes in files of other programs are written and read back, by a foreign reader where there is one."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.ply_files import columns_of, ply_bytes, random_still
from helpers.scene_files import moving_scene
from pxr import Usd, UsdGeom, UsdVol

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.ply import write_ply
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.viewer.cli import view_command
from lapgs_wgpu.viewer.export import export_compact, export_frames
from lapgs_wgpu.viewer.export_usd import export_usd
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, load_scene
from lapgs_wgpu.viewer.moving_files import open_moving

N = 40
TIMES = (0.0, 0.4, 1.0)


@pytest.fixture(scope="module")
def scene(device: Device, tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    file = tmp_path_factory.mktemp("moving") / "a.ply"
    moving_scene(device, FieldConfig(kind="grid4d", width=8), sh_degree=3).save(file)
    return load_scene(file, lambda: device)


@pytest.mark.parametrize("ending", ["usda", "usdz"])
def test_usd(scene: LoadedScene, device: Device, tmp_path: Path, ending: str) -> None:
    """usd-core's camera sees usd-core's positions within 0.1 pixels of where ours are, at three times."""
    file = tmp_path / f"a.{ending}"
    assert export_usd(scene, file, 61).psnr > 40
    stage = Usd.Stage.Open(str(file))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Splats"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 60)
    assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(scene.clock().seconds)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(0)
    to_world = UsdGeom.Xformable(splats.GetPrim()).ComputeLocalToWorldTransform(0)
    to_screen = np.array(to_world * camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix())
    ours = scene.camera().camera(640, 480)
    for t in TIMES:
        positions = np.array(splats.GetPositionsAttr().Get(60 * t))
        seen = np.c_[positions, np.ones(len(positions))] @ to_screen
        seen = (seen[:, :2] / seen[:, 3:] * [0.5, -0.5] + 0.5) * [640, 480]
        wanted, depth = ours.project(scene.playback.at(t).means.read().astype(float))
        assert np.abs(seen - wanted)[depth > 0.1].max() < 0.1
        now = scene.playback.at(t)
        turns = [[q.GetReal(), *q.GetImaginary()] for q in splats.GetOrientationsAttr().Get(60 * t)]
        quats = now.quats.read()
        alike = np.abs((np.array(turns) * quats).sum(axis=1)) / np.linalg.norm(quats, axis=1)
        np.testing.assert_allclose(alike, 1, atol=1e-5)
        np.testing.assert_allclose(splats.GetScalesAttr().Get(60 * t), now.scales.read(), rtol=1e-5)
        np.testing.assert_allclose(splats.GetOpacitiesAttr().Get(60 * t), now.opacities.read(), atol=1e-6)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 3
    assert splats.GetOpacitiesAttr().GetNumTimeSamples() == 1  # does not change
    read = load_scene(file, lambda: device)
    assert (read.clock().frames, read.clock().seconds) == (61, pytest.approx(scene.clock().seconds))
    np.testing.assert_allclose(read.camera().position, scene.camera().position)


def test_a_sequence_and_back_to_usd(scene: LoadedScene, device: Device, tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "frame_7.ply").touch()
    with pytest.raises(InputError, match="is not empty"):
        export_frames(scene, tmp_path / "frames", 4)
    assert export_frames(scene, tmp_path / "frames", 4, overwrite=True).psnr > 90
    read = load_scene(tmp_path / "frames", lambda: device)
    assert (read.clock().frames, read.clock().seconds) == (4, pytest.approx(scene.clock().seconds))
    for t in (0.0, 1 / 3, 1.0):
        np.testing.assert_array_equal(read.playback.at(t).means.read(), scene.playback.at(t).means.read())
    assert export_usd(read, tmp_path / "b.usdc", 4).psnr > 30  # straight lines between what were four frames
    with pytest.raises(InputError, match="no field"):
        export_compact(read, tmp_path / "b.lapgs")


def test_frames_of_others_with_other_counts(device: Device, tmp_path: Path) -> None:
    for number, count in ((1, 5), (2, 8), (10, 3)):
        write_ply(tmp_path / f"f{number}.ply", random_still(count, seed=number))
        if number == 1:  # a folder of one
            assert load_scene(tmp_path, lambda: device).playback.count == 5
    scene = load_scene(tmp_path, lambda: device)
    assert (scene.playback.count, scene.clock().frames) == (8, 3)
    for t, count in ((0.0, 5), (0.5, 8), (1.0, 3)):
        opacities = scene.playback.at(t).opacities.read()
        assert (np.flatnonzero(opacities == 0) >= count).all()
        assert (opacities > 0).sum() == count


def spacetime(tmp_path: Path) -> tuple[Path, Path, dict[str, np.ndarray]]:
    """The same scene of Spacetime Gaussians as .ply and as .splatv; its columns."""
    rng, still = np.random.default_rng(0), random_still(N, 0)
    names = [*(f"motion_{i}" for i in range(9)), *(f"omega_{i}" for i in range(4))]
    values = {name: 0.2 * rng.normal(size=N) for name in names}
    values |= {"trbf_center": rng.random(N), "trbf_scale": np.log(0.2 + rng.random(N))}
    values |= {f"f_dc_{i}": rng.integers(0, 256, N) / 255 for i in range(3)}
    columns = {name: column for name, column in columns_of(still).items() if not name.startswith("f_rest")}
    columns |= {name: ("float", column) for name, column in values.items()}
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    c = {name: np.asarray(column, np.float32) for name, (_, column) in columns.items()}
    words = np.zeros((N + 24, 16), "<u4")  # rows that fill the texture's last line are zeros
    rows = words[:N]
    rows[:, :3] = np.stack([c["x"], c["y"], c["z"]], axis=1).view("<u4")
    halves = [*(c[f"rot_{i}"] for i in range(4)), *(np.exp(c[f"scale_{i}"]) for i in range(3))]
    later = [*(c[f"motion_{i}"] for i in range(9)), np.zeros(N), *(c[f"omega_{i}"] for i in range(4))]
    later += [c["trbf_center"], np.exp(c["trbf_scale"])]
    rows.view("<f2")[:, 6:13], rows.view("<f2")[:, 16:32] = np.stack(halves, 1), np.stack(later, 1)
    rgba = [255 * c[f"f_dc_{i}"] for i in range(3)] + [255 / (1 + np.exp(-c["opacity"]))]
    rows.view("u1")[:, 28:32] = np.stack(rgba, axis=1).round()
    camera = {"position": [0, 0, -4], "rotation": np.eye(3).tolist(), "fx": 60, "fy": 60, "width": 64, "height": 48}
    text = json.dumps([{"type": "splat", "size": words.nbytes, "cameras": [camera]}]).encode()
    (tmp_path / "a.splatv").write_bytes(struct.pack("<II", 0x674B, len(text)) + text + words.tobytes())
    return tmp_path / "a.ply", tmp_path / "a.splatv", c


def test_spacetime_gaussians(device: Device, tmp_path: Path) -> None:
    ply, splatv, c = spacetime(tmp_path)
    scene, packed = load_scene(ply, lambda: device), load_scene(splatv, lambda: device)
    for t in TIMES:
        since = t - c["trbf_center"]
        means = [
            c[axis] + sum(c[f"motion_{3 * k + i}"] * since ** (k + 1) for k in range(3)) for i, axis in enumerate("xyz")
        ]
        fade = np.exp(-((since / np.exp(c["trbf_scale"])) ** 2))
        now, other = scene.playback.at(t), packed.playback.at(t)
        np.testing.assert_allclose(now.means.read(), np.stack(means, axis=1), atol=1e-5)
        np.testing.assert_allclose(now.opacities.read(), fade / (1 + np.exp(-c["opacity"])), atol=1e-5)
        turned = np.stack([c[f"rot_{i}"] + since * c[f"omega_{i}"] for i in range(4)], axis=1)
        np.testing.assert_allclose(now.quats.read(), turned, atol=1e-5)
        shown = now.sh.read()[:, 0] * 0.28209479 + 0.5
        np.testing.assert_allclose(shown, np.stack([c[f"f_dc_{i}"] for i in range(3)], axis=1), atol=1e-5)
        kept = np.arange(N)[((255 / (1 + np.exp(-c["opacity"]))).round() > 0)]
        np.testing.assert_allclose(other.means.read(), now.means.read()[kept], atol=2e-3)
        np.testing.assert_allclose(other.opacities.read(), now.opacities.read()[kept], atol=6e-3)
    np.testing.assert_allclose(packed.camera().position, [0, 0, -4], atol=1e-6)
    assert view_command([str(ply), "--screenshot", str(tmp_path / "a.png"), "--size", "64x48", "--time", "0.5"]) == 0


def manifest(tmp_path: Path, **changes: Any) -> Path:
    write_ply(tmp_path / "a.ply", random_still(3, 0))
    (tmp_path / "sequence.json").write_text(json.dumps({"fps": 24, "frames": ["a.ply"]} | changes))
    return tmp_path / "sequence.json"


def test_what_cannot_be_opened_is_named(tmp_path: Path, device: Device) -> None:
    for changes, told in (({"frames": ["../a.ply"]}, "frames"), ({"fps": 0}, "fps"), ({"fps": "x"}, "fps")):
        with pytest.raises(InputError, match=told):
            open_moving(manifest(tmp_path, **changes))
    _, splatv, _ = spacetime(tmp_path)
    data = splatv.read_bytes()
    for damaged in (data[:-1], b"", data[:6], data[:8] + b"{" + data[9:], b"xy" + data[2:]):
        splatv.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.splatv"):
            open_moving(splatv)
    for name, text in (("a.usda", "#usda 1.0\n"), ("b.usda", "nothing"), ("a.4dgs", "nothing"), ("a.spz", "\x1f")):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=name):
            load_scene(tmp_path / name, lambda: device)
