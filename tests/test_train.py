"""The training from end to end, in the smallest size: it learns, it repeats to the last byte, it leaves a whole run."""

import dataclasses
import io
import json
import re
import signal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.training import STEPS, configure
from PIL import Image

from lapgs_wgpu import run as run_module
from lapgs_wgpu.data import Dataset
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.checkpoint import read_checkpoint
from lapgs_wgpu.motion.scene import Scene4D, load
from lapgs_wgpu.run import train
from lapgs_wgpu.train import exchange_step
from lapgs_wgpu.train.config import LossWeights
from lapgs_wgpu.train.exchange_step import RenderLoss, render_loss
from lapgs_wgpu.train.log import Log
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import initial_points, resolve_for_dataset, resolve_step
from lapgs_wgpu.train.step_result import Measured, StepResult


def lines(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("kind", ["static", "mlp", "hexplane", "grid4d", "laplacian"])
def test_pictures_improve(kind: str, dataset: Dataset, device: Device, tmp_path: Path) -> None:
    psnrs: list[float] = []
    original = Log.step

    def note(self: Log, result: StepResult, *rest: Any) -> None:
        psnrs.append(result.psnr)
        original(self, result, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Log, "step", note)
        # Without a reset, after which all opacities would have to come back first.
        config = configure(method=kind, density__reset_interval="1000")
        train(config, dataset, tmp_path / "run", device=device)
    assert len(psnrs) == STEPS
    assert np.mean(psnrs[-6:]) > np.mean(psnrs[:6]) + 2


def test_a_run_is_whole(trained_run: Path, data: Path, dataset: Dataset) -> None:
    assert {file.name for file in trained_run.iterdir()} == {
        "config.toml", "log.jsonl", "metrics.json", "checkpoint.ply", "eval",
    }  # fmt: skip
    assert resolve_for_dataset(configure(), dataset).field.components == 4  # of 8 times
    assert load_config(str(trained_run / "config.toml")) == dataclasses.replace(
        configure(data__path=str(data)), step_place="exchange"
    )
    record = (trained_run / "config.toml").read_text().split("[record]")[1]
    assert all(f"\n{key} = " in record for key in ("lapgs_wgpu", "torch", "adapter", "driver"))
    (last,) = lines(trained_run)
    assert set(last) == {
        "step", "loss", "psnr", "terms", "gaussians", "timing",
    }  # fmt: skip
    assert set(last["terms"]) == {"l1", "ssim", "pyramid", "ncc", "smoothness", "acceleration", "dynamics"}
    assert sum(last["terms"].values()) == pytest.approx(last["loss"], rel=1e-5)
    frequencies = read_checkpoint(trained_run / "checkpoint.ply").tensors["field.motion.frequencies"]
    assert frequencies.tolist() != list(range(4))  # they are learnt
    assert frequencies.max() <= 3.5  # the Nyquist frequency of 8 pictures
    assert last["step"] == STEPS
    metrics = json.loads((trained_run / "metrics.json").read_text())
    assert metrics["training"]["steps"] == STEPS
    assert [row["view"] for row in metrics["views"]] == [view.name for view in dataset.test]
    assert metrics["gaussians"] == last["gaussians"]
    for view in dataset.test:
        assert Image.open(trained_run / "eval" / f"{view.name}.png").size == (3 * 32, 32)


@pytest.mark.parametrize("validated", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_an_evaluation_while_training_changes_nothing(
    trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path, *, validated: bool
) -> None:
    val = tuple(dataclasses.replace(view, name=f"val_{view.name}") for view in dataset.test) if validated else ()
    watched = dataclasses.replace(dataset, val=val)
    train(configure(eval__interval=str(STEPS // 2)), watched, tmp_path / "run", device=device)
    first, second = (line for line in lines(tmp_path / "run") if "val_psnr" in line)
    assert [first["step"], second["step"]] == [STEPS // 2, STEPS // 2 * 2]
    assert first["val_views"] == second["val_views"] == ("val" if validated else "train")
    assert all(0 < line["val_psnr"] < 60 for line in (first, second))
    assert second["timing"]["seconds"] > first["timing"]["seconds"] > 0
    assert load(tmp_path / "run" / "checkpoint.ply", device).metadata["step"] == str(STEPS)
    written, known = (read_checkpoint(folder / "checkpoint.ply").tensors for folder in (tmp_path / "run", trained_run))
    assert written.keys() == known.keys()
    assert all(np.array_equal(written[name], known[name]) for name in known)
    if validated and STEPS % 2 == 0:
        psnr = json.loads((tmp_path / "run" / "metrics.json").read_text())["psnr"]
        assert second["val_psnr"] == pytest.approx(psnr, abs=1e-3)


def test_the_checkpoint_is_the_last_model(trained_run: Path, dataset: Dataset, device: Device) -> None:
    scene = load(trained_run / "checkpoint.ply", device)
    metrics = run_module.evaluate(scene, dataset.test, "black")
    stored = json.loads((trained_run / "metrics.json").read_text())
    assert metrics["views"] == stored["views"]
    assert scene.sh_degree == 3
    assert scene.metadata["background"] == "black"


def test_the_format_names_what_a_checkpoint_says_of_itself(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    moved = dataclasses.replace(dataset, normalization=Normalization(np.zeros(3), 1.0))
    # Whose times are corrected.
    config = configure(
        schedule__warm_up="0", schedule__steps="8", timing__refine="true", timing__start="6", timing__interval="1"
    )
    train(config, moved, tmp_path / "run", device=device)
    written = read_checkpoint(tmp_path / "run" / "checkpoint.ply").metadata
    text = (Path(__file__).parents[1] / "docs" / "format.md").read_text(encoding="utf-8")
    table = text.split("Metadata, all texts:")[1].split("\n\n")[1]
    rows = [row.split("|")[1:3] for row in table.splitlines()]
    about = {name: meaning for names, meaning in rows for name in re.findall(r"`(\w+)`", names)}
    assert set(about) == set(written)
    for name in ("view", "placement"):
        assert set(json.loads(written[name])) <= set(re.findall(r"`(\w+)`", about[name]))


def test_the_training_never_sees_the_test_views(
    trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not one is opened before the model is saved, and without them it is the same to the last byte."""

    def refuse() -> np.ndarray:
        raise AssertionError("a test view was opened")

    class SavedError(Exception):
        pass

    def stop(*_: object) -> None:
        raise SavedError

    blind = tuple(dataclasses.replace(view, load=refuse, time=0.5) for view in dataset.test[:1])
    monkeypatch.setattr(run_module, "evaluate_run", stop)
    with pytest.raises(SavedError):
        train(configure(), dataclasses.replace(dataset, test=blind), tmp_path / "run", device=device)
    assert (tmp_path / "run" / "checkpoint.ply").read_bytes() == (trained_run / "checkpoint.ply").read_bytes()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("smoothness__static", "5"), ("smoothness__temporal", "5"), ("loss__dynamics", "1"), ("loss__pyramid", "1"),
        ("loss__ncc", "1"), ("loss__ssim", "0.5"), ("rates__frequencies__start", "2e-3"), ("density__split", "plain"),
    ],
)  # fmt: skip
def test_each_part_of_the_method_reaches_the_model(
    key: str, value: str, trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path
) -> None:
    """None of these changes how many random numbers are drawn before the first step that differs."""
    train(configure(**{key: value}), dataset, tmp_path / "run", device=device)
    assert (tmp_path / "run" / "checkpoint.ply").read_bytes() != (trained_run / "checkpoint.ply").read_bytes()


def test_a_training_repeats_to_the_last_byte(
    trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path
) -> None:
    train(configure(), dataset, tmp_path / "second", device=device)
    assert (tmp_path / "second" / "checkpoint.ply").read_bytes() == (trained_run / "checkpoint.ply").read_bytes()
    first, second = lines(trained_run), lines(tmp_path / "second")
    for line in first + second:
        del line["timing"]
    assert first == second


@pytest.mark.nightly
def test_the_resident_step_trains_as_well_and_repeats(
    trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path
) -> None:
    config = dataclasses.replace(configure(), step_place="resident")
    for name in ("first", "again"):
        train(config, dataset, tmp_path / name, device=device)
    assert load_config(str(tmp_path / "first/config.toml")) == config
    assert (tmp_path / "first/checkpoint.ply").read_bytes() == (tmp_path / "again/checkpoint.ply").read_bytes()
    psnrs = [json.loads((folder / "metrics.json").read_text())["psnr"] for folder in (tmp_path / "first", trained_run)]
    assert psnrs[0] == pytest.approx(psnrs[1], abs=0.5)


@pytest.mark.parametrize(
    ("given", "is_cpu", "place"),
    [
        ({}, True, "exchange"),
        ({}, False, "resident"),
        ({"method": "grid4d"}, False, "resident"),
        ({"method": "static"}, False, "resident"),
        ({"method": "hexplane"}, False, "exchange"),
        ({"field__depth": "1"}, False, "exchange"),
        ({"cameras__refine": "on"}, False, "resident"),
        ({"step_place": "exchange"}, False, "exchange"),
        ({"step_place": "resident"}, True, "resident"),
    ],
)
def test_where_the_step_is_computed(
    given: dict[str, str], is_cpu: bool, place: str, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "is_cpu", is_cpu)
    config = configure(**given)
    assert resolve_step(config, device, Parts()) == dataclasses.replace(config, step_place=place)


def test_nothing_moves_during_the_warm_up(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    config = configure(schedule__steps="4")
    scene = train(config, dataset, tmp_path / "run", device=device)
    field = resolve_for_dataset(config, dataset).field
    fresh = Scene4D.from_points(*initial_points(config.points, dataset, 0), field, device=device)
    assert scene.field is not None
    assert fresh.field is not None
    for ours, initial in zip(scene.field.parameters(), fresh.field.parameters(), strict=True):
        assert torch.equal(ours, initial)
    moved = train(configure(schedule__steps="4", schedule__warm_up="3"), dataset, tmp_path / "moved", device=device)
    assert moved.field is not None
    assert not all(
        torch.equal(ours, initial)
        for ours, initial in zip(moved.field.parameters(), fresh.field.parameters(), strict=True)
    )


def test_cross_correlation_counts_once_the_warm_up_is_over(
    dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all losses."""
    seen: list[tuple[LossWeights, RenderLoss]] = []

    def spy(*arguments: Any) -> RenderLoss:
        seen.append((arguments[4], render_loss(*arguments)))
        return seen[-1][1]

    monkeypatch.setattr(exchange_step, "render_loss", spy)
    options = {"loss__pyramid": "0.2", "loss__ncc": "0.05"}
    config = configure(schedule__steps="4", schedule__warm_up="2", **options)
    train(config, dataset, tmp_path / "run", device=device)
    assert [weights.ncc for weights, _ in seen] == [0, 0, 0.05, 0.05]
    for weights, done in seen:
        assert weights[:3] == pytest.approx((0.8, 0.2, 0.2))
        terms = {"ncc": 0.0} | done.terms
        loss = 0.8 * terms["l1"] + 0.2 * terms["ssim"] + 0.2 * terms["pyramid"] + weights.ncc * terms["ncc"]
        assert done.loss.item() == pytest.approx(loss, rel=1e-5)


def test_ctrl_c_leaves_a_whole_checkpoint(
    dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = Log.step

    def interrupt(self: Log, result: StepResult, *rest: Any) -> None:
        original(self, result, *rest)
        if result.step == 5:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Log, "step", interrupt)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=r"stopped after step 5 of 36; .*checkpoint.ply holds it"):
        train(configure(), dataset, tmp_path / "run", device=device)
    assert load(tmp_path / "run" / "checkpoint.ply", device).metadata["step"] == "5"
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_folder_in_use_is_left_alone(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"is not empty.*--overwrite"):
        train(configure(), dataset, tmp_path, device=device)
    with pytest.raises(InputError, match="is a file"):
        train(configure(), dataset, tmp_path / "notes.txt", device=device, overwrite=True)
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_overwriting_replaces_a_run_and_nothing_else(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "eval").mkdir()
    (tmp_path / "eval" / "old.png").write_text("old")
    (tmp_path / "config.toml").write_text("[record]\ndata = '1234'\n")
    train(configure(schedule__steps="2"), dataset, tmp_path, device=device, overwrite=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "eval" / "old.png").exists()


def test_seconds_before_the_first_step_count_once(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    for done, steps in ((0, 50), (50, 100)):
        with Log(path, 100, done=done, before=1000.0, terminal=io.StringIO()) as log:
            if not done:
                log.discovered("nothing")
            for step in range(done + 1, steps + 1):
                log.step(StepResult(step, 100, lambda: Measured(0.5, 20.0)), 1000)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 50, 100]
    assert lines[0]["discovery"] == "nothing"
    seconds = [line["timing"]["seconds"] for line in lines]
    assert 1000 <= seconds[0] <= seconds[1] <= seconds[2] < 1900


def test_log_lines_and_the_progress_line(tmp_path: Path) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream in (io.StringIO(), Terminal()):
        with Log(tmp_path / "log.jsonl", 120, terminal=stream) as log:
            for step in range(1, 121):
                terms = {"l1": 0.25, "ssim": 0.25 + step}
                measured = Measured(0.5 + step, 20.0, terms=terms)
                log.step(StepResult(step, 120, partial(lambda told: told, measured)), 1000)
        text = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
        assert [line["step"] for line in text] == [50, 100, 120]
        assert text[0]["loss"] == pytest.approx(0.5 + np.mean(range(1, 51)))
        assert text[2]["loss"] == pytest.approx(0.5 + np.mean(range(71, 121)))
        assert all(sum(line["terms"].values()) == pytest.approx(line["loss"]) for line in text)
        shown = stream.getvalue()
        assert "step 120/120  20.00 dB  1000 Gaussians" in shown
        assert shown.rstrip().endswith("0:00 left")
        assert shown.endswith("\n")
        assert ("\r" in shown) == stream.isatty()
        assert "\x1b" not in shown  # older consoles of Windows show escape codes


@pytest.mark.parametrize(("quick", "told"), [(30, "  0:00 left"), (31, "  more than 0:00 left")])
def test_time_left_is_a_bound_while_steps_are_quick(quick: int, told: str, tmp_path: Path) -> None:
    terminal = io.StringIO()
    with Log(tmp_path / "log.jsonl", 30, quick=quick, terminal=terminal) as log:
        for step in range(1, 31):
            log.step(StepResult(step, 30, lambda: Measured(0.5, 20.0)), 1000)
    assert terminal.getvalue().rstrip().endswith(told)
