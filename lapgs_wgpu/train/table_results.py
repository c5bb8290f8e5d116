"""The measured runs of a table: one of a run folder, all of a results.json, and the Markdown that shows them."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.dataclass_table import Options, build_dataclass, checked, option
from lapgs_wgpu.io.safe_json_toml import read_json, read_toml
from lapgs_wgpu.train.config import HeldOut
from lapgs_wgpu.train.presets import Table, load_config
from lapgs_wgpu.train.run_folder import SPLITS
from lapgs_wgpu.train.table_spec import Run, RunKey, fingerprint

FORMAT = "lapgs-table 1"
QUALITIES = (30, 33, 36)  # dB
# The figures that a run may lack.
OPTIONAL = ("ms_ssim", "lpips", "lpips_unscaled", "psnr_moving", "found", "track_error")


@dataclass(frozen=True)
class Result(Options):
    """A finished run."""

    scene: str = option("name of the scene")
    row: str = option("name of the row")
    seed: int = option("seed of the training")
    fingerprint: str = option("of the configuration")
    psnr: float = option("mean over the test views, dB")
    ssim: float = option("mean over the test views", at_least=-1, at_most=1)
    gaussians: int = option("number of Gaussians")
    steps: int = option("training steps")
    seconds: float = option("time of the training, with motion discovery and without evaluation")
    size: tuple[int, int] = option("width and height of the images, pixels", at_least=1)
    views: int = option("number of test views")
    overrides: Table = option("what the configuration changed of the preset")
    environment: dict[str, str] = option("versions, adapter and driver")
    split: HeldOut = option("which views these figures are of, as data.split", "test")
    ms_ssim: float | None = option("mean over the test views; None where it was not measured", None)
    lpips: float | None = option("mean over the test views; None where it was not measured", None)
    lpips_unscaled: float | None = option("the same of inputs in [0, 1]; None where it was not measured", None)
    psnr_moving: float | None = option("docs/metrics.md; None where it was not measured", None)
    found: float | None = option("docs/metrics.md; None where it was not measured", None)
    track_error: float | None = option("docs/metrics.md; None where it was not measured", None)
    curve: tuple[tuple[float, float], ...] = option(
        "seconds of training and PSNR of the validation views, dB, at each eval.interval; none where it is 0", ()
    )

    @property
    def key(self) -> RunKey:
        return RunKey(self.scene, self.row, self.seed)

    @property
    def steps_per_second(self) -> float:
        return self.steps / max(self.seconds, 1e-9)


@dataclass(frozen=True)
class Results:
    """What a results.json holds: the name of the table, its preset and the finished runs."""

    name: str
    preset: str
    runs: tuple[Result, ...]


def read_run(folder: Path, run: Run) -> Result | None:
    """What a run folder holds; None where the run is not finished, has another configuration, or was measured on other
    views."""
    try:
        metrics = read_json(folder / "metrics.json")
        record = read_toml(folder / "config.toml")["record"]
        made = fingerprint(load_config(str(folder / "config.toml")))
        # An interrupted run that lapgs-train --eval measured has metrics, too.
        steps, seconds = metrics["training"]["steps"], metrics["training"]["seconds"]
        split = metrics.get("split", run.config.data.split)
        if (made, steps, split) != (run.fingerprint, run.config.schedule.steps, run.config.data.split):
            return None
        entry = {
            **run.key._asdict(),
            "fingerprint": made,
            "psnr": metrics["psnr"],
            "ssim": metrics["ssim"],
            "gaussians": metrics["gaussians"],
            "steps": steps,
            "seconds": seconds,
            "size": metrics["size"],
            "views": len(metrics["views"]),
            "split": split,
            "overrides": run.overrides,
            "environment": record,
            "curve": _curve(folder / "log.jsonl"),
            **{name: metrics[name] for name in OPTIONAL if isinstance(metrics.get(name), int | float)},
        }
        return build_dataclass(Result, entry, str(folder))
    except (OSError, ValueError, KeyError, TypeError):  # missing or damaged: it is trained again
        return None


def _curve(log: Path) -> list[tuple[float, float]]:
    """Seconds and PSNR of each measurement in a log.jsonl on validation views, which not all captures have."""
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    return [(line["timing"]["seconds"], line["val_psnr"]) for line in lines if line.get("val_views") == "val"]


def seconds_to(curve: Sequence[tuple[float, float]], psnr: float) -> float | None:
    """When a curve first reaches a PSNR, on straight lines between its measurements; None where it never does."""
    for k, (seconds, reached) in enumerate(curve):
        if reached >= psnr:
            if k == 0:
                return seconds
            earlier, lower = curve[k - 1]
            return earlier + (seconds - earlier) * (psnr - lower) / (reached - lower)
    return None


def read_results(path: Path) -> Results:
    """Read a results.json. Raises InputError."""
    if not path.exists():
        raise InputError(f"{path} does not exist; give a results.json that lapgs-table wrote.")
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path} is no results.json of this version of lapgs-table (format {FORMAT!r}).")
    name, preset = (checked(str, content.get(key), f"{path}: {key}") for key in ("name", "preset"))
    runs = content.get("runs")
    if not isinstance(runs, list):
        raise InputError(f"{path}: runs must be a list, got {shown(runs)}.")
    return Results(
        name, preset, tuple(build_dataclass(Result, run, f"{path}: run {number}") for number, run in enumerate(runs, 1))
    )


def merge_results(parts: Sequence[Results]) -> Results:
    """The runs of several files, in order. InputError where they hold one run in two configurations."""
    runs: dict[RunKey, Result] = {}
    for part in parts:
        for run in part.runs:
            first = runs.setdefault(run.key, run)
            if first.fingerprint != run.fingerprint:
                raise InputError(
                    f"{run.key}: the files hold this run in two configurations, {shown(first.overrides)} and "
                    f"{shown(run.overrides)} beside the preset; give the SPEC, too."
                )
    return Results(parts[0].name, parts[0].preset, tuple(runs.values()))


def write_results(folder: Path, results: Results) -> None:
    """Write results.json and table.md. Atomic."""
    with atomic_write(folder / "results.json") as file:
        file.write((json.dumps(_content(results), indent=1) + "\n").encode())
    with atomic_write(folder / "table.md") as file:
        file.write(markdown(results).encode())


def _content(results: Results) -> dict[str, Any]:
    """What a results.json holds; figures that a run lacks are left out."""
    content = dataclasses.asdict(results)
    runs = [{name: value for name, value in run.items() if value not in (None, ())} for run in content["runs"]]
    return {"format": FORMAT, **content, "runs": runs}


def markdown(results: Results) -> str:
    """The tables: a line for each scene and row, then the means over the scenes, then with what they were made."""
    lines = [f"## {results.name}", ""]
    if not results.runs:
        return "\n".join([*lines, "No run is finished yet.", ""])
    cells: dict[tuple[str, str], list[Result]] = {}
    for run in results.runs:
        cells.setdefault((run.scene, run.row), []).append(run)
    formats = _formats(results.runs)
    lines += _head(formats, "scene", "model", "seeds")
    lines += [
        _line(formats, (scene, row, str(len(runs))), _spread([run.psnr for run in runs]), _means(runs, formats))
        for (scene, row), runs in cells.items()
    ]
    scenes = {scene for scene, _ in cells}
    if len(scenes) > 1:
        lines += ["", "Means over the scenes; only lines with the same scenes compare.", ""]
        lines += _head(formats, "model", "scenes")
        for row in dict.fromkeys(row for _, row in cells):
            parts = [runs for (_, other), runs in cells.items() if other == row]
            of_scenes = [_means(runs, formats) for runs in parts]
            means = {name: _mean([each[name] for each in of_scenes]) for name in formats}
            texts = (row, f"{len(parts)} of {len(scenes)}")
            lines.append(_line(formats, texts, _spread(_means_of_seeds(parts)), means))
    if any(run.curve for run in results.runs):
        lines += ["", *_times_to_quality(cells)]
    return "\n".join([*lines, "", *_environments(results), ""])


def _times_to_quality(cells: Mapping[tuple[str, str], Sequence[Result]]) -> Iterable[str]:
    """The table of the seconds that the runs of each scene and row took to reach each of QUALITIES, and of the best."""
    yield (
        "Seconds of training, motion discovery included, until the validation views reach a PSNR: means over the "
        "seeds, - where a seed does not reach it. best: the highest PSNR of these views. Only rows whose runs measured "
        "the validation views."
    )
    yield ""
    columns = [f"{psnr} dB" for psnr in QUALITIES]
    yield f"| scene | model | {' | '.join(columns)} | best |"
    yield f"|---|---|{'---:|' * (len(columns) + 1)}"
    for (scene, row), runs in cells.items():
        if all(run.curve for run in runs):
            times = [_mean([seconds_to(run.curve, psnr) for run in runs]) for psnr in QUALITIES]
            texts = ["-" if seconds is None else f"{seconds:,.0f}" for seconds in times]
            best = mean(max(psnr for _, psnr in run.curve) for run in runs)
            yield f"| {scene} | {row} | {' | '.join(texts)} | {best:.2f} dB |"


# The figures that are averaged, in the order of their columns: the name of the column, and how each is shown.
_FORMATS = {
    "psnr": ("PSNR", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "ms_ssim": ("MS-SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "lpips_unscaled": ("LPIPS [0, 1]", "{:.4f}"),
    "gaussians": ("Gaussians", "{:,.0f}"),
    "steps_per_second": ("steps/s", "{:.1f}"),
    "seconds": ("training, s", "{:,.0f}"),
    "psnr_moving": ("moving PSNR", "{:.2f}"),
    "found": ("found", "{:.0%}"),
    "track_error": ("track", "{:.2f}"),
}


def _formats(runs: Sequence[Result]) -> dict[str, tuple[str, str]]:
    """Those of _FORMATS that any run has."""
    return {name: text for name, text in _FORMATS.items() if any(getattr(run, name) is not None for run in runs)}


def _means(runs: Sequence[Result], names: Iterable[str]) -> dict[str, float | None]:
    return {name: _mean([getattr(run, name) for run in runs]) for name in names}


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean, None where any value is missing."""
    known = [value for value in values if value is not None]
    return mean(known) if len(known) == len(values) else None


def _means_of_seeds(parts: Sequence[Sequence[Result]]) -> list[float]:
    """For each seed that all scenes have, its mean PSNR over them."""
    by_seed: dict[int, list[float]] = {}
    for run in (run for runs in parts for run in runs):
        by_seed.setdefault(run.seed, []).append(run.psnr)
    return [mean(values) for values in by_seed.values() if len(values) == len(parts)]


def _spread(values: Sequence[float]) -> str:
    """The sample standard deviation, which one value does not have."""
    return f"{stdev(values):.2f}" if len(values) > 1 else "-"


def _head(formats: Mapping[str, tuple[str, str]], *columns: str) -> list[str]:
    psnr, *others = (name for name, _ in formats.values())
    names = [*columns, psnr, "±", *others]
    left = sum(name in ("scene", "model") for name in columns)
    return [f"| {' | '.join(names)} |", f"|{'|'.join(['---'] * left + ['---:'] * (len(names) - left))}|"]


def _line(
    formats: Mapping[str, tuple[str, str]], texts: Sequence[str], spread: str, means: Mapping[str, float | None]
) -> str:
    shown = {name: "-" if means[name] is None else text.format(means[name]) for name, (_, text) in formats.items()}
    psnr, *others = shown.values()
    return f"| {' | '.join((*texts, psnr, spread, *others))} |"


def _environments(results: Results) -> Iterable[str]:
    """What the figures hold for: pictures, versions, adapter; and how many runs, where that is not the same for all."""
    yield (
        f"{len(results.runs)} runs of the preset `{results.preset}`. ± is the sample standard deviation of the PSNR "
        "over the seeds; the training's time is with motion discovery and without evaluation."
    )
    if any(run.psnr_moving is not None for run in results.runs):
        yield ""
        yield "moving PSNR is of moving pixels (docs/metrics.md)."
    if any(run.found is not None for run in results.runs):
        yield ""
        yield (
            "found is the share of test frames with each moving object in its place; track, the error of its position "
            "in diameters, - where it is not found (docs/metrics.md)."
        )
    sizes = Counter(f"{run.views} {SPLITS[run.split]} views of {'x'.join(map(str, run.size))}" for run in results.runs)
    shown = ("adapter", "driver", "system", "python", "torch", "wgpu", "lapgs_wgpu", "revision")
    made = Counter(
        ", ".join(f"{name} {run.environment[name]}" for name in shown if name in run.environment)
        for run in results.runs
    )
    for counter in (sizes, made):
        yield ""
        counted = ((text, f"{n} run{'s' if n > 1 else ''}") for text, n in counter.items())
        yield "; ".join(f"{text} ({runs})" if len(counter) > 1 else text for text, runs in counted) + "."
