"""Compact scenes: what a file keeps of a checkpoint, and what is refused."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.scene_files import moving_scene, scene_of_outliers
from helpers.trained_scenes import CONFIGS, OURS, trained

from lapgs_wgpu import load
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.lapgs_file import MAGIC, MAX_BYTES, lapgs_bytes, pack_lapgs, unpack_lapgs
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.playback.playback import DevicePlayback, playback_of
from lapgs_wgpu.motion.scene_file import SceneFile, compact_bytes, read_scene
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.viewer import cli

FEW = 400


def checkpoint(device: Device, folder: Path, config: FieldConfig, count: int = FEW) -> SceneFile:
    trained(device, config, count).save(folder / "a.ply", {"background": "white"})
    return read_scene(folder / "a.ply")


def compact(device: Device, folder: Path, file: SceneFile) -> Path:
    playback = playback_of(file, device)
    assert isinstance(playback, DevicePlayback)
    (folder / "a.lapgs").write_bytes(compact_bytes(file, playback.static_features()))
    return folder / "a.lapgs"


@pytest.mark.parametrize("name", CONFIGS)
def test_every_field_is_kept(device: Device, tmp_path: Path, name: str) -> None:
    """Within the steps of its quantization; what needs no rounding, exactly."""
    file = checkpoint(device, tmp_path, CONFIGS[name])
    found = read_scene(compact(device, tmp_path, file))
    assert (found.field_config, found.sh_degree) == (file.field_config, file.sh_degree)
    assert found.metadata == {"background": "white"}
    assert found.field.keys() == file.field.keys() - {"static_grid.table"}
    for parameter, values in found.field.items():
        allowed = 2e-2 * np.abs(file.field[parameter]).max() if parameter.endswith("table") else 1e-3
        np.testing.assert_allclose(values, file.field[parameter], rtol=1e-3, atol=allowed)
        assert values.dtype == np.float32
    if file.field_config.appearance_size < 4:
        limit = np.log(CONSTANTS["ALPHA_MIN"] / (1 - CONSTANTS["ALPHA_MIN"]))
        assert len(found.gaussians["means"]) == (file.gaussians["opacity_logits"] >= limit).sum() < FEW
    else:
        means = file.gaussians["means"]
        own = 0.03 * np.median(np.exp(file.gaussians["log_scales"]), axis=1, keepdims=True)  # of the Gaussian's size
        allowed = np.maximum(np.ptp(means, axis=0).max() / 65535, own)
        assert (np.abs(found.gaussians["means"] - means) <= allowed).all()
        features = playback_of(file, device).static_features()  # type: ignore[attr-defined]
        steps = np.abs(features).max(axis=0) / 31
        assert (np.abs(found.gaussians["static_features"] - features) <= 0.51 * steps + 1e-6).all()


def test_exact_features_give_the_same_bits(device: Device, tmp_path: Path) -> None:
    """H_s of each Gaussian stands for the static table without any loss of its own."""
    file = checkpoint(device, tmp_path, OURS)
    whole = playback_of(file, device)
    assert isinstance(whole, DevicePlayback)
    gaussians = file.gaussians | {"static_features": whole.static_features()}
    field = {name: values for name, values in file.field.items() if name != "static_grid.table"}
    without = SceneFile("", file.field_config, file.sh_degree, gaussians, field, {})
    assert playback_of(without, device).at(0.3).means.read().tobytes() == whole.at(0.3).means.read().tobytes()


def test_equal_scenes_give_equal_bytes(device: Device, tmp_path: Path) -> None:
    file = checkpoint(device, tmp_path, OURS)
    first = compact(device, tmp_path, file).read_bytes()
    assert compact(device, tmp_path, file).read_bytes() == first
    assert len(first) < 0.4 * (tmp_path / "a.ply").stat().st_size


def test_a_still_scene(device: Device, tmp_path: Path) -> None:
    scene = moving_scene(device, FieldConfig(kind="static"), sh_degree=1)
    scene.antialiased = 0.1
    scene.save(tmp_path / "a.ply")
    found = read_scene(compact(device, tmp_path, read_scene(tmp_path / "a.ply")))
    assert found.field == {}
    assert found.sh_degree == 1
    assert found.antialiased == 0.1
    assert not found.gaussians["sh_rest"][:, 3:].any()


def test_lapgs_view_opens_and_writes_it(device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint(device, tmp_path, OURS)
    scene, again, page = (str(tmp_path / name) for name in ("b.lapgs", "c.lapgs", "d.html"))
    assert cli.view_command([str(tmp_path / "a.ply"), "--export", scene]) == 0
    assert cli.view_command([scene, "--export", again]) == 0
    assert cli.view_command([scene, "--screenshot", str(tmp_path / "a.png"), "--size", "64x48"]) == 0
    assert cli.view_command([scene, "--export", page]) == 0
    assert f"{page}: {FEW} Gaussians" in capsys.readouterr().out
    assert cli.view_command([scene, "--export", page]) == 2
    assert "is there already; --overwrite replaces it" in capsys.readouterr().err
    assert cli.view_command([scene, "--export", scene, "--overwrite"]) == 2
    assert "is the opened file; take another name" in capsys.readouterr().err
    assert cli.view_command([scene, "--export", page, "--time", "0.5"]) == 2
    assert "--time has no use" in capsys.readouterr().err
    with pytest.raises(InputError, match="is a compact scene, which lapgs-view shows"):
        load(scene)


@pytest.mark.parametrize("kind", ["mlp", "hexplane"])
def test_fields_of_torch_are_refused(device: Device, tmp_path: Path, kind: str) -> None:
    moving_scene(device, FieldConfig(kind=kind, width=8)).save(tmp_path / "a.ply")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=f"only torch evaluates its field \\({kind}"):
        compact_bytes(read_scene(tmp_path / "a.ply"), None)


# Outliers


def test_far_and_overexposed_gaussians_cost_the_others_nothing(tmp_path: Path) -> None:
    """Six far points of 5,006, some colors of 50, opaque and empty ones: all within what is seen."""
    file = scene_of_outliers(5000)
    (tmp_path / "a.lapgs").write_bytes(compact_bytes(file, None))
    held = file.gaussians["opacity_logits"] > -5.5
    true = {name: values[held].astype(np.float64) for name, values in file.gaussians.items()}
    found = read_scene(tmp_path / "a.lapgs").gaussians
    sizes = np.exp(true["log_scales"])
    assert len(found["means"]) == held.sum() == 5004
    assert (np.linalg.norm(found["means"] - true["means"], axis=1) <= 0.06 * sizes.max(axis=1)).all()
    assert np.abs(found["log_scales"] - true["log_scales"]).max() <= 0.03
    colors = 0.5 + CONSTANTS["SH_C0"] * true["sh_dc"]
    error = CONSTANTS["SH_C0"] * np.abs(found["sh_dc"] - true["sh_dc"])
    assert (error <= 0.008 * np.maximum(1, np.abs(colors)) + 1e-6).all()
    assert (tmp_path / "a.lapgs").read_bytes()[8:12] == b"\2\0\0\0"
    without = compact_bytes(scene_of_outliers(5000, outliers=False), None)
    assert without[8:12] == b"\1\0\0\0"  # which earlier programs read
    assert (tmp_path / "a.lapgs").stat().st_size < 1.15 * len(without)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("outliers", lambda places: places[::-1].copy()),
        ("outliers", lambda places: places + np.uint32(1 << 20)),
        ("outliers", lambda places: places[:-1]),
        ("outliers", lambda places: places.astype(np.int32)),
        ("exact", lambda values: values[:-1]),
        ("exact", lambda values: values.astype(np.float64)),
    ],
)
def test_damaged_outliers_are_refused(tmp_path: Path, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    (tmp_path / "a.lapgs").write_bytes(compact_bytes(scene_of_outliers(50), None))
    tensors, metadata = unpack_lapgs((tmp_path / "a.lapgs").read_bytes(), "a.lapgs")
    tensors[f"gaussians.means.{name}"] = change(tensors[f"gaussians.means.{name}"])
    (tmp_path / "a.lapgs").write_bytes(pack_lapgs(tensors, metadata))
    with pytest.raises(InputError, match=r"gaussians\.means\.(outliers|exact)"):
        read_scene(tmp_path / "a.lapgs")


# The container


def rewritten(path: Path, content: bytes, version: int = 1, size: int | None = None) -> Path:
    path.write_bytes(
        struct.pack("<8sIQ", MAGIC, version, len(content) if size is None else size) + zlib.compress(content)
    )
    return path


@pytest.mark.parametrize(
    ("version", "size", "packed", "reason"),
    [
        (3, None, b"", "has version 3 of the compact scene, and this program reads versions 1 to 2"),
        (0, None, b"", "has version 0 of the compact scene"),
        (1, MAX_BYTES + 1, b"", f"declares {MAX_BYTES + 1} bytes"),
        (1, 10**6, b"", "declares 1000000 bytes in [0-9]+ packed ones"),
        (1, 20, b"", "do not hold the 20"),
        (1, 18, b"", "do not hold the 18"),
        (1, None, b"more", "do not hold"),
    ],
)
def test_containers_that_are_refused(
    tmp_path: Path, version: int, size: int | None, packed: bytes, reason: str
) -> None:
    path = rewritten(tmp_path / "a.lapgs", b"nineteen characters", version, size)
    path.write_bytes(path.read_bytes() + packed)
    with pytest.raises(InputError, match=reason):
        read_scene(path)


def test_equal_values() -> None:
    """What deflate alone would shorten more than readers accept is stored in more bytes."""
    values = np.zeros(10**6, np.uint8)
    data = pack_lapgs({"a": values}, {})
    assert 10**6 / 64 < len(data) < 10**6 / 4
    assert (unpack_lapgs(data, "a.lapgs")[0]["a"] == values).all()


def test_a_truncated_file(tmp_path: Path) -> None:
    data = pack_lapgs({"a": np.arange(1000, dtype=np.uint16)}, {"b": "c"})
    path = tmp_path / "a.lapgs"
    path.write_bytes(data)
    tensors, metadata = unpack_lapgs(data, "a.lapgs")
    assert (tensors["a"] == np.arange(1000)).all()
    assert metadata == {"b": "c"}
    for length in (8, 19, 20, 40, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match="damaged"):
            read_scene(path)


def test_what_is_not_there_is_no_compact_scene(tmp_path: Path) -> None:
    assert lapgs_bytes(tmp_path / "missing") is None
    assert lapgs_bytes(tmp_path) is None
