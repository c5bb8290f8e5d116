"""The plots of a run: what is drawn of which scene, and that the figures show the values."""

from __future__ import annotations

import builtins
import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from lapgs_wgpu import cli
from lapgs_wgpu.data.synthetic import write_synthetic
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train import plots

pytest.importorskip("matplotlib")

LINES = [{"step": 50 * i, "loss": 0.1 / i, "psnr": 20.0 + i, "gaussians": 100 * i} for i in range(1, 5)]


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Each figure that is saved, by the name of its file."""
    saved: dict[str, Any] = {}
    original = plots._save

    def note(figure: Any, path: Path, title: str, panels: Any) -> None:
        saved[path.name] = figure
        original(figure, path, title, panels)

    monkeypatch.setattr(plots, "_save", note)
    return saved


def make_scene(device: Device, kind: str, n: int = 60) -> Scene4D:
    grid = HashConfig(2, (4, 4, 4), (8, 8, 8), 10)
    config = FieldConfig(kind=kind, static=grid, temporal=grid, width=8, components=2)  # type: ignore[arg-type]
    points = np.random.default_rng(0).uniform(-1, 1, (n, 3))
    scene = Scene4D.from_points(points, np.full((n, 3), 0.5), np.full(n, 0.1), config, opacity=0.5, device=device)
    if scene.field is not None:
        with torch.no_grad():
            scene.field.heads.weight.normal_(generator=torch.Generator().manual_seed(0))
    return scene


def make_run(folder: Path, lines: list[dict]) -> Path:
    (folder / "run").mkdir()
    (folder / "run" / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder / "run"


def lines_of(axes: Any) -> list[list[float]]:
    return [list(line.get_ydata()) for line in axes.get_lines()]


def is_a_picture(file: Path) -> bool:
    """Readable, large enough, and not of one color."""
    with Image.open(file) as image:
        return image.width >= 600 and image.height >= 300 and np.asarray(image.convert("L")).std() > 5


def test_a_static_scene_has_training_curves_alone(device: Device, tmp_path: Path) -> None:
    run = make_run(tmp_path, LINES)
    drawn = plots.plot_run(run, make_scene(device, "static"))
    assert [file.relative_to(run).as_posix() for file in drawn] == ["eval/plots/training.png"]
    assert all(map(is_a_picture, drawn))


def test_a_moving_scene_has_trajectories(device: Device, tmp_path: Path) -> None:
    drawn = plots.plot_run(make_run(tmp_path, LINES), make_scene(device, "grid4d"))
    assert [file.name for file in drawn] == ["training.png", "trajectories.png"]
    assert all(map(is_a_picture, drawn))


def test_a_spectrum_and_dynamics_are_drawn_where_the_scene_has_them(
    device: Device, tmp_path: Path, figures: dict[str, Any]
) -> None:
    scene = make_scene(device, "laplacian")
    motion = scene.spectrum
    assert motion is not None
    with torch.no_grad():
        motion.frequencies.copy_(torch.tensor([1.0, 2.5]))
        for values, other in ((motion.alpha, (3.0, 0.0)), (motion.beta, (4.0, 1.0))):
            values.copy_(torch.tensor(other)[:, None].expand(2, 8))
        scene.parameters["dynamics"].fill_(1.0)
    path = [{**line, "frequencies": [1.0, 2.0 + 0.1 * i], "amplitudes": [i, 2 * i]} for i, line in enumerate(LINES)]
    drawn = plots.plot_run(make_run(tmp_path, path), scene)
    assert {file.name for file in drawn} == {
        "training.png", "spectrum-path.png", "spectrum.png", "dynamics.png", "trajectories.png",
    }  # fmt: skip
    assert all(map(is_a_picture, drawn))

    (stems,) = figures["spectrum.png"].axes[0].containers
    assert list(stems.markerline.get_xdata()) == [1.0, 2.5]
    assert list(stems.markerline.get_ydata()) == pytest.approx([5.0, 1.0])  # roots of 9 + 16 and of 1
    frequencies, amplitudes = figures["spectrum-path.png"].axes
    assert lines_of(frequencies) == [pytest.approx([1.0] * 4), pytest.approx([2.0, 2.1, 2.2, 2.3])]
    assert lines_of(amplitudes) == [[0, 1, 2, 3], [0, 2, 4, 6]]
    assert figures["dynamics.png"].axes[0].get_legend().get_texts()[0].get_text() == "median 4"


def test_training_curves_show_the_log(tmp_path: Path, figures: dict[str, Any]) -> None:
    plots.training_curves(tmp_path / "a.png", [50, 100], [0.2, 0.1], [20, 25], [10, 30])
    loss, psnr, gaussians = figures["a.png"].axes
    assert [lines_of(axes)[0] for axes in (loss, psnr, gaussians)] == [[0.2, 0.1], [20, 25], [10, 30]]
    assert "dB" in psnr.get_ylabel()
    assert gaussians.get_xlabel() == "training step"


def test_trajectories_have_a_panel_for_each_axis(tmp_path: Path, figures: dict[str, Any]) -> None:
    places = np.random.default_rng(0).normal(size=(5, 6, 3))
    plots.trajectories(tmp_path / "a.png", np.linspace(0, 1, 5), places)
    for axis, axes in enumerate(figures["a.png"].axes):
        assert axes.get_ylabel() == f"{'xyz'[axis]} (world units)"
        assert np.array_equal(lines_of(axes), places[:, :, axis].T)
        assert len({(line.get_color(), line.get_linestyle()) for line in axes.get_lines()}) == 6


def test_the_gaussians_that_travel_furthest_are_shown(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(device, "grid4d")
    speed = torch.zeros(len(scene))
    speed[[7, 20, 33, 41, 50]] = torch.tensor([9.0, 5.0, 7.0, 3.0, 1.0])
    with torch.no_grad():
        scene.parameters["opacity_logits"][7] = -10  # the fastest, which nobody sees
    means = scene.parameters["means"].detach()

    def at(t: float) -> SimpleNamespace:
        return SimpleNamespace(means=means + speed[:, None] * t)

    monkeypatch.setattr(scene, "at", at)
    times, places = plots.sample_trajectories(scene)
    assert (times[0], times[-1]) == (0, 1)
    assert np.array_equal(places[0, :4], means[[33, 20, 41, 50]].numpy())
    assert np.allclose(places[-1, :4] - places[0, :4], [[7], [5], [3], [1]], atol=1e-5)


def test_a_damaged_log_leaves_the_curves_out(device: Device, tmp_path: Path) -> None:
    run = make_run(tmp_path, LINES)
    scene = make_scene(device, "static")
    for text in ("\udcff", '{"step": 3', "[1]\n3\n", '{"step": 3}'):
        (run / "log.jsonl").write_bytes(text.encode(errors="surrogateescape"))
        assert plots.plot_run(run, scene) == []
    (run / "log.jsonl").unlink()
    assert plots.plot_run(run, scene) == []


def test_the_same_run_gives_the_same_picture(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        plots.dynamics_histogram(tmp_path / name, np.random.default_rng(0).normal(size=(100, 16)))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_evaluation_plots_and_does_without_matplotlib(
    device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, run = write_synthetic(tmp_path / "toys", size=24, train_views=3, test_views=2), tmp_path / "run"
    fast = ["--steps", "3", "--points.count", "50", "--field.width", "8"]
    assert cli.train_command(["tiny", "--data", str(scene), "--out", str(run), *fast]) == 0
    assert not (run / "eval" / "plots").exists()
    found, imported = importlib.util.find_spec, builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        return None if name == "matplotlib" else found(name, *rest)

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        assert not name.startswith("matplotlib")
        return imported(name, *rest, **more)

    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", without)
        patch.setattr(builtins, "__import__", refuse)
        capsys.readouterr()
        assert cli.train_command(["--eval", str(run)]) == 0
    progress, told = capsys.readouterr().err.splitlines()
    assert progress.startswith("2/2 test views measured")
    assert 'pip install "lapgs-wgpu[plots]"' in told
    assert not (run / "eval" / "plots").exists()

    assert cli.train_command(["--eval", str(run)]) == 0
    drawn = {file.name for file in (run / "eval" / "plots").iterdir()}
    assert drawn == {"training.png", "trajectories.png", "spectrum.png", "dynamics.png"}
    assert capsys.readouterr().err.count("\n") == 1  # the progress alone
