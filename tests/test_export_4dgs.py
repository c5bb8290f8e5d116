"""Straight pieces of motion in a .4dgs file, read back by the reference implementation of the format."""

from __future__ import annotations

from pathlib import Path

import fourdgs
import numpy as np
import pytest
import torch
from fourdgs.validate import validate
from helpers.playback import open_playback
from helpers.reference import sh_basis as reference_basis
from helpers.scene_files import moving_scene
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lapgs_wgpu import Scene4D
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.fourdgs_file import _symbols, bytes_harmonics, harmonics_bytes
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.playback.linear_pieces import linear_pieces, piece_errors, roots_of, state
from lapgs_wgpu.motion.timing import Timing
from lapgs_wgpu.splat.linear_light import directions, display_colors, linear_harmonics, sh_basis, to_display, to_linear
from lapgs_wgpu.viewer import cli, export_4dgs
from lapgs_wgpu.viewer.export_4dgs import Baked, bake_4dgs, best_degree
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, load_scene

COUNT = 60
MOMENTS = np.random.default_rng(1).random(12)  # of the clip


def calm(device: Device) -> Scene4D:
    """A scene whose Gaussians move by about their size, smoothly."""
    scene = moving_scene(device, count=COUNT)
    assert scene.field is not None
    with torch.no_grad():
        for name, parameter in scene.field.named_parameters():
            if name.startswith(("heads", "appearance")):
                parameter *= 0.1
    return scene


@pytest.fixture(scope="module")
def scene(device: Device, tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    file = tmp_path_factory.mktemp("baked") / "a.ply"
    calm(device).save(file)
    return load_scene(file, lambda: device)


@pytest.fixture(scope="module")
def baked(scene: LoadedScene) -> Baked:
    return bake_4dgs(scene, 0.5)


def pixel(scene: LoadedScene) -> float:
    """World units at the focus."""
    camera = scene.camera()
    return float(2 * np.tan(0.5 * camera.fov_y) * camera.distance / scene.look.camera.height)


def test_the_reference_implementation_finds_no_fault(baked: Baked) -> None:
    report = validate(baked.data)
    assert [str(finding) for finding in report.findings if finding.severity != "note"] == []


def test_gaussians_are_where_the_field_has_them(scene: LoadedScene, baked: Baked, tmp_path: Path) -> None:
    """At moments that the bake did not look at: as many as are drawn, each as near as the file states."""
    assert baked.error <= 0.5
    (tmp_path / "a.4dgs").write_bytes(baked.data)
    read = fourdgs.read(tmp_path / "a.4dgs")
    assert read.duration_sec == pytest.approx(scene.clock().seconds)
    gaussians = read.gaussians
    scales, quats = np.asarray(gaussians.scales), np.asarray(gaussians.rotations)
    colors = np.asarray(gaussians.colors)
    moved = 0.0
    for t in MOMENTS.tolist():
        true = state(scene.playback, t, np.arange(COUNT))
        now = gaussians.state_at(t * read.duration_sec)
        live = now["indices"]
        away, which = cKDTree(true[:, :3]).query(now["centers"])
        assert len(set(which.tolist())) == len(live) == baked.gaussians
        assert away.max() < 0.6 * pixel(scene)
        roots = roots_of(scales[live], quats[live])
        assert (away + np.linalg.norm(roots - true[which, 3:9], axis=1)).max() < 0.6 * pixel(scene)
        np.testing.assert_allclose(now["opacity"], true[which, 9], atol=0.02)
        assert colors[live, :3].min() >= 0
        start = state(scene.playback, 0.0, np.arange(COUNT))
        moved = max(moved, float(np.abs(true[:, :3] - start[:, :3]).max() / pixel(scene)))
    assert moved > 10  # pixels: there is something to bake


def test_camera_and_texts(scene: LoadedScene, baked: Baked, tmp_path: Path) -> None:
    (tmp_path / "a.4dgs").write_bytes(baked.data)
    read = fourdgs.read(tmp_path / "a.4dgs")
    assert read.camera is not None
    np.testing.assert_allclose(read.camera.position, scene.camera().position)
    np.testing.assert_allclose(read.camera.target, scene.camera().focus)
    assert read.camera.fov_y_deg == pytest.approx(np.degrees(scene.camera().fov_y))
    assert read.header.attributes["color_space"] == "linear-rec709-display"
    assert f"at most {baked.error:.2f} pixels" in read.header.attributes["source"]


def test_pieces_join_and_are_as_many_as_needed(scene: LoadedScene) -> None:
    coarse, fine = (linear_pieces(scene.playback, far * pixel(scene), 1.0) for far in (2.0, 0.2))
    assert len(fine.source) > len(coarse.source) >= COUNT
    for pieces, far in ((coarse, 2.0), (fine, 0.2)):
        assert piece_errors(scene.playback, pieces).max() <= far * pixel(scene)
        same = np.diff(pieces.source) == 0
        assert (pieces.begin[1:][same] == pieces.end[:-1][same]).all()  # all can be seen at all times
        assert (pieces.begin[1:][~same] == 0).all()
        assert (pieces.end[:-1][~same] == 1).all()


def test_motion_that_goes_by_jerks_is_as_near(device: Device, tmp_path: Path) -> None:
    """A field whose images are early and late by turns: its path bends at each of 100 times."""
    scene = calm(device)
    times = np.linspace(0, 1, 100)
    moments = times + 0.4 / 99 * np.where(np.arange(100) % 2, 1, -1)
    scene.timing = Timing(times, moments.clip(0, 1))
    scene.save(tmp_path / "a.ply")
    playback = open_playback(tmp_path / "a.ply", device)
    span = np.ptp([state(playback, t, np.arange(COUNT))[:, :3] for t in np.linspace(0, 1, 9)], axis=0).max()
    far = 6e-3 * span
    pieces = linear_pieces(playback, far, 1.0)
    worst = 0.0
    for t in np.random.default_rng(0).random(200).tolist():
        shown = np.flatnonzero((pieces.begin <= t) & (t < pieces.end))
        way = (t - 0.5 * (pieces.begin + pieces.end)[shown])[:, None] * pieces.slopes[shown]
        true = state(playback, t, pieces.source[shown])[:, :3]
        worst = max(worst, float(np.linalg.norm(pieces.means[shown] + way - true, axis=1).max()))
    assert worst <= 1.2 * far


def test_what_stands_still_is_one_piece(device: Device, tmp_path: Path) -> None:
    scene = calm(device)
    assert scene.field is not None
    with torch.no_grad():
        for parameter in scene.field.parameters():
            parameter.zero_()
    scene.save(tmp_path / "a.ply")
    pieces = linear_pieces(open_playback(tmp_path / "a.ply", device), 1e-4, 0.01)
    assert len(pieces.source) == COUNT
    assert np.abs(pieces.slopes).max() < 1e-4


def test_roots_of_covariances() -> None:
    rng = np.random.default_rng(0)
    scales, quats = np.exp(rng.normal(size=(20, 3))), rng.normal(size=(20, 4))
    axes = Rotation.from_quat(quats).as_matrix()
    for root, R, S in zip(roots_of(scales, quats), axes, scales, strict=True):
        xx, yy, zz, xy, xz, yz = root / np.array([1, 1, 1, 2, 2, 2]) ** 0.5
        matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(matrix @ matrix, R @ np.diag(S**2) @ R.T, rtol=1e-9, atol=1e-9)
        assert np.linalg.norm(root) == pytest.approx(np.linalg.norm(matrix))


# Colors


def test_the_basis_is_that_of_the_reference() -> None:
    around = directions(50)
    np.testing.assert_allclose(np.linalg.norm(around, axis=1), 1)
    for degree in range(4):
        expected = reference_basis(torch.from_numpy(around), degree).numpy()
        np.testing.assert_allclose(sh_basis(around, degree), expected, atol=1e-6)


def test_linear_light_is_displayed_as_before() -> None:
    values = np.linspace(0, 1, 300)
    np.testing.assert_allclose(to_display(to_linear(values)), values, atol=1e-6)
    sh = 0.1 * np.random.default_rng(0).normal(size=(40, 16, 3))
    around = directions(64)
    light = np.einsum("dk,nkc->ndc", sh_basis(around, 3), linear_harmonics(sh, 3)).clip(0, 1)
    true = display_colors(sh, sh_basis(around, 3))
    assert np.abs(light - to_linear(true)).mean() < 0.02
    assert np.abs(light - to_linear(true)).mean() < 0.2 * np.abs(true - to_linear(true)).mean()


def test_harmonics_are_kept_where_they_show() -> None:
    rng = np.random.default_rng(0)
    bright, dark = np.zeros((30, 16, 3)), np.zeros((30, 16, 3))
    bright[:, 1:] = 0.3 * rng.normal(size=(30, 15, 3))
    dark[:, 0], dark[:, 1:] = -1.6, 0.003 * rng.normal(size=(30, 15, 3))
    assert best_degree(bright) == 3
    assert best_degree(dark) == 0
    values = rng.uniform(-4, 4, size=(100, 3))
    np.testing.assert_allclose(bytes_harmonics(harmonics_bytes(values)), values, atol=4 / 255 + 1e-9)


# The command


def test_the_command(device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calm(device).save(tmp_path / "a.ply")
    source, file = str(tmp_path / "a.ply"), tmp_path / "b.4dgs"
    assert cli.view_command([source, "--export", str(file), "--max-error", "3"]) == 0
    said = capsys.readouterr().out
    assert f"{file}: {COUNT} Gaussians as " in said
    assert "pixels of the captured images from the learned motion" in said
    assert file.read_bytes().startswith(b"\x894DGS1")
    for options, reason in (
        (["--export", str(file)], "is there already; --overwrite replaces it"),
        (["--export", str(file), "--time", "0.5"], "which holds the whole clip"),
        (["--export", str(tmp_path / "c.ply"), "--max-error", "3"], "only a .4dgs file needs it"),
        (["--export", str(file), "--max-error", "0"], "expected a number from 0.01 to 100"),
    ):
        assert cli.view_command([source, *options]) == 2
        assert reason in capsys.readouterr().err


def test_a_folder_that_is_missing_is_told_before_the_work(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calm(device).save(tmp_path / "a.ply")
    monkeypatch.setattr(export_4dgs, "bake_4dgs", lambda *_: pytest.fail("minutes of work"))
    assert cli.view_command([str(tmp_path / "a.ply"), "--export", str(tmp_path / "none/b.4dgs")]) == 2
    assert "none/b.4dgs: not written" in capsys.readouterr().err


def test_what_is_too_far_for_the_format_is_refused() -> None:
    with pytest.raises(InputError, match="so far away at such a precision; give a larger --max-error"):
        _symbols(np.array([[1 << 31]]))
    assert _symbols(np.array([[(1 << 31) - 1]]))[0] == 4


def test_a_still_scene_is_refused(device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moving_scene(device, FieldConfig(kind="static")).save(tmp_path / "a.ply")
    assert cli.view_command([str(tmp_path / "a.ply"), "--export", str(tmp_path / "b.4dgs")]) == 2
    assert "holds no motion; --export FILE.ply" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["mlp", "hexplane"])
def test_fields_of_torch_are_baked_too(device: Device, tmp_path: Path, kind: str) -> None:
    moving_scene(device, FieldConfig(kind=kind, width=8), count=4).save(tmp_path / "a.ply")  # type: ignore[arg-type]
    assert bake_4dgs(load_scene(tmp_path / "a.ply", lambda: device), 20.0).gaussians > 0
