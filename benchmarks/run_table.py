"""Tables of many runs: python benchmarks/run_table.py SPEC.toml --data DIR --out OUT

A table has a preset, several scenes, rows (methods, or changed keys) and seeds; docs/tables/demo.toml describes SPEC.
Each run has its own run folder, OUT/SCENE/ROW/seedN; OUT/results.json has the results of all finished ones. The same
command again skips what is finished and resumes the run that was interrupted. Exit code 1: a run failed.
"""

import argparse
import dataclasses
import json
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from lapgs_wgpu.command import DEVICE_HELP, guarded
from lapgs_wgpu.data.built_in import SYNTHETIC
from lapgs_wgpu.errors import DeviceError, InputError, NumericalError, shown
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.dataclass_table import Options, build_dataclass, checked, option
from lapgs_wgpu.io.safe_json_toml import read_json, read_toml
from lapgs_wgpu.run import resume, train
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.evaluate import Lpips
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.run_folder import STATE
from lapgs_wgpu.train.setup import open_data

_NAME = re.compile(r"\w[\w .+=-]*", re.ASCII)  # of a scene or a row: of a folder, and a cell of a Markdown table
# Columns of the printed table: entry of a result, heading, format.
_COLUMNS = (
    ("psnr", "PSNR", ".2f"), ("ssim", "SSIM", ".4f"), ("lpips", "LPIPS", ".4f"), ("gaussians", "Gaussians", ",.0f"),
    ("seconds", "seconds", ",.0f"),
)  # fmt: skip

Result = dict[str, Any]  # of a run: scene, row, seed, and the figures of its metrics.json


@dataclass(frozen=True)
class Run:
    """A run of a table. folder: of the scene, relative to --data, or "synthetic"."""

    scene: str
    row: str
    seed: int
    folder: str
    config: Config

    def __str__(self) -> str:
        return f"{self.scene}, {self.row}, seed {self.seed}"


@dataclass(frozen=True)
class _SpecFile(Options):
    """The file that defines a table (docs/tables/demo.toml describes the format)."""

    preset: str = option("preset of all runs")
    seeds: tuple[int, ...] = option("seeds of each row")
    scenes: dict[str, Any] = option("name -> folder, or a table with the key folder and keys of the configuration")
    rows: dict[str, Any] = option("name -> method, ablate, scenes, seeds and keys of the configuration")


def read_spec(path: Path) -> list[Run]:
    """Read the file that defines a table. Returns its runs, scene by scene. Raises InputError before any training where
    a name, a key or a value of any run is not valid."""
    table = read_toml(path)
    common = _dotted(table.pop("common", {}), f"{path}: common")  # keys of the configuration, for all runs
    spec = build_dataclass(_SpecFile, table, str(path))
    for name in (*spec.scenes, *spec.rows):
        if not _NAME.fullmatch(name):
            raise InputError(f"{path}: {name!r} must be a name of letters, digits, spaces and . + = _ - only.")
    runs = []
    for scene, value in spec.scenes.items():
        of_scene = _dotted({"folder": value} if isinstance(value, str) else value, f"{path}: scenes.{scene}")
        folder = checked(str, of_scene.pop("folder", None), f"{path}: scenes.{scene}.folder")
        for row, row_table in spec.rows.items():
            where = f"{path}: rows.{row}"
            of_row = _dotted(row_table, where)
            scenes = checked(tuple[str, ...], of_row.pop("scenes", list(spec.scenes)), f"{where}.scenes")
            seeds = checked(tuple[int, ...], of_row.pop("seeds", list(spec.seeds)), f"{where}.seeds")
            if unknown := [name for name in scenes if name not in spec.scenes]:
                raise InputError(f"{where}.scenes: {shown(unknown[0])} is no scene of this table.")
            ablate = checked(tuple[str, ...], of_row.pop("ablate", []), f"{where}.ablate")
            method = of_row.pop("method", None)
            for seed in seeds if scene in scenes else ():
                try:
                    values = {**common, **of_scene, **of_row, "seed": seed}
                    config = load_config(spec.preset, values, method=method, ablate=ablate)
                except InputError as error:
                    raise InputError(f"{path}: scenes.{scene}, rows.{row}: {error}") from None
                runs.append(Run(scene, row, seed, folder, config))
    return runs


def make_table(
    runs: Sequence[Run], data: Path, out: Path, *, device: Device | None = None, lpips: Lpips | None = None
) -> list[Run]:
    """Train the runs that are not finished, and write `out`/results.json anew after each.

    Args:
        runs: of `read_spec`.
        data: the folder in which the scenes' folders are.
        out: of the table; a run's own folder is `out`/SCENE/ROW/seedN.
        device: None for the default adapter.
        lpips: of the evaluation.

    Returns:
        The runs that failed, each of which has told why on stderr.

    Raises:
        InputError: a scene's folder does not exist.
        KeyboardInterrupt: a signal ended it; the training under way has saved its state.
    """
    for run in runs:
        if run.folder != SYNTHETIC and not (data / run.folder).exists():
            raise InputError(f"{data / run.folder}, the scene {run.scene}, does not exist; --data names its folder.")
    failed = []
    for number, run in enumerate(runs, 1):
        if read_result(out, run) is not None:
            continue
        print(f"run {number} of {len(runs)}: {run}", file=sys.stderr)
        try:
            with redirect_stdout(sys.stderr):  # stdout gets the table alone
                _train(run, data, out, device, lpips)
        except (InputError, DeviceError, NumericalError, MemoryError, OSError) as error:
            print(f"{run}: {str(error) or 'out of memory'}", file=sys.stderr)
            failed.append(run)
        results = [result for each in runs if (result := read_result(out, each)) is not None]
        out.mkdir(parents=True, exist_ok=True)
        with atomic_write(out / "results.json") as file:
            file.write((json.dumps(results, indent=1) + "\n").encode())
    return failed


def run_folder(out: Path, run: Run) -> Path:
    """The folder of a run in the table's folder."""
    return out / run.scene / run.row / f"seed{run.seed}"


def read_result(out: Path, run: Run) -> Result | None:
    """The results of a finished run; None where its folder holds no run, an unfinished one, or one of another
    configuration."""
    folder = run_folder(out, run)
    try:
        metrics = read_json(folder / "metrics.json")
        if not _holds(folder, run.config) or metrics["training"]["steps"] != run.config.schedule.steps:
            return None
        figures = {name: metrics[name] for name in ("psnr", "ssim", "ms_ssim", "lpips", "gaussians", "size")}
        seconds, environment = metrics["training"]["seconds"], metrics["environment"]
    except (InputError, KeyError, TypeError):
        return None
    names = {"scene": run.scene, "row": run.row, "seed": run.seed}
    return {**names, **figures, "seconds": seconds, "views": len(metrics["views"]), "environment": environment}


def markdown(results: Sequence[Result]) -> str:
    """The table of finished runs: a line for each scene and row, with means over the seeds and the sample standard
    deviation of the PSNR; then means over the scenes, in which each scene weighs alike."""
    columns = [column for column in _COLUMNS if any(_is_number(each[column[0]]) for each in results)]
    heads = ["scene", "row", "seeds", "PSNR", "±", *(head for _, head, _ in columns[1:])]
    lines = [f"| {' | '.join(heads)} |", f"|---|---|{'---:|' * (len(heads) - 2)}"]
    scenes, rows = (list(dict.fromkeys(each[name] for each in results)) for name in ("scene", "row"))

    def line(scene: str, row: str, parts: list[list[Result]]) -> str:
        """Of the results of each scene."""
        seeds = set.intersection(*({each["seed"] for each in part} for part in parts))
        psnrs = [mean(each["psnr"] for part in parts for each in part if each["seed"] == seed) for seed in seeds]
        texts = [scene, row, str(max(map(len, parts)))]
        for name, _, form in columns:
            known = all(_is_number(each[name]) for part in parts for each in part)
            texts.append(format(mean(mean(each[name] for each in part) for part in parts), form) if known else "-")
        texts.insert(4, f"{stdev(psnrs):.2f}" if len(psnrs) > 1 else "-")
        return f"| {' | '.join(texts)} |"

    of_rows = {
        row: [[r for r in results if (r["scene"], r["row"]) == (scene, row)] for scene in scenes] for row in rows
    }
    for number, scene in enumerate(scenes):
        lines += [line(scene, row, [parts[number]]) for row, parts in of_rows.items() if parts[number]]
    if len(scenes) > 1:  # means over fewer scenes would not compare
        lines += [line("mean", row, parts) for row, parts in of_rows.items() if all(parts)]
    return "\n".join(lines)


def _is_number(value: object) -> bool:
    """Whether a measure is known; a text says why it is not."""
    return isinstance(value, int | float)


def _dotted(table: Any, where: str, prefix: str = "") -> dict[str, Any]:
    """Dotted key -> value of a nested table. Raises InputError where a key is not the spec's to set."""
    if not isinstance(table, dict):
        raise InputError(f"{where} must be a table of keys of the configuration, got {shown(table)}.")
    keys: dict[str, Any] = {}
    for name, value in table.items():
        key = f"{prefix}{name}"
        if key in ("seed", "data.path"):
            raise InputError(f"{where} must set neither seed nor data.path: the keys seeds and scenes do.")
        keys |= _dotted(value, where, f"{key}.") if isinstance(value, dict) else {key: value}
    return keys


def _holds(folder: Path, config: Config) -> bool:
    """Whether a folder holds a run of this configuration, wherever its data are and its steps were computed."""

    def comparable(config: Config) -> Config:
        data = dataclasses.replace(config.data, path="", masks="")
        return dataclasses.replace(config, step_place="auto", data=data)

    try:
        return comparable(load_config(str(folder / "config.toml"))) == comparable(config)
    except InputError:  # it is not there, or damaged
        return False


def _train(run: Run, data: Path, out: Path, device: Device | None, lpips: Lpips | None) -> None:
    """Train a run, or resume it."""
    folder = run_folder(out, run)
    path = SYNTHETIC if run.folder == SYNTHETIC else str(data / run.folder)
    config = dataclasses.replace(run.config, data=dataclasses.replace(run.config.data, path=path))
    config, dataset = open_data(config, out)
    if (folder / STATE).is_file() and _holds(folder, run.config):
        resume(config, dataset, folder, device=device, lpips=lpips)
    else:
        train(config, dataset, folder, device=device, overwrite=True, lpips=lpips)


def options() -> argparse.ArgumentParser:
    """The parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("spec", type=Path, metavar="SPEC.toml", help="definition of the table")
    add("--data", type=Path, metavar="DIR", default=Path("."), help="folder that contains the scenes' folders [.]")
    add("--out", type=Path, metavar="OUT", required=True, help="output folder for the runs and results.json")
    add("--device", metavar="NAME", help=DEVICE_HELP)
    add("--lpips-weights", type=Path, metavar="FILE", help="also compute LPIPS with the weights in FILE")
    return parser


def main(arguments: list[str]) -> int:
    """Make the table and print it; returns the exit code."""
    given = options().parse_args(arguments)
    runs = read_spec(given.spec)
    lpips = Lpips(given.lpips_weights) if given.lpips_weights else None
    failed = make_table(runs, given.data, given.out, device=open_device(given.device), lpips=lpips)
    print(markdown([result for run in runs if (result := read_result(given.out, run)) is not None]))
    for run in failed:
        print(f"{run} failed.", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(guarded("run_table", main, sys.argv[1:]))
