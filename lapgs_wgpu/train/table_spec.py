"""What a table is made of: a TOML file that names a preset, scenes, rows (fields or ablations) and seeds.

preset = "tiny"
seeds = [0, 1, 2]

[common]                          # keys of the configuration, for every run
data.background = "black"

[scenes]                          # name = folder, relative to --data; "synthetic" is the built-in scene
toys = "synthetic"                # and "motion:path=4,cycles=2" one that measures motion
lego = { folder = "lego", points.box = 1.5 }

[rows]                            # name = a method (--field) and what it is without (--ablate), keys of the
grid4d = { method = "grid4d" }    # configuration, and to which scenes and seeds the row is kept
no_ncc = { ablate = ["ncc"], scenes = ["toys"], seeds = [0], loss.pyramid = 0.1 }
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from lapgs_wgpu.data.builtin import builtin_folder, is_builtin
from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.dataclass_table import did_you_mean
from lapgs_wgpu.io.safe_json_toml import read_toml
from lapgs_wgpu.train.config import CamerasConfig, Config
from lapgs_wgpu.train.presets import Table, build_config, load_config, merge, preset_names, shorthands

MOST_RUNS = 10_000
_NAME = re.compile(r"\w[\w .+=-]*", re.ASCII)  # becomes the name of a folder, and a cell of a Markdown table
# Names of devices on Windows.
_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{port}{number}" for port in ("COM", "LPT") for number in range(1, 10))}


class RunKey(NamedTuple):
    """Which run of a table."""

    scene: str
    row: str
    seed: int

    def __str__(self) -> str:
        return f"{self.scene}, {self.row}, seed {self.seed}"


@dataclass(frozen=True)
class Run:
    """A run that a table wants. folder: of the scene, relative to --data. overrides: what the spec says of it."""

    key: RunKey
    folder: str
    config: Config
    overrides: Table

    @property
    def fingerprint(self) -> str:
        return fingerprint(self.config)


@dataclass(frozen=True)
class Spec:
    """A table as it is wanted: its name, and every run, scene by scene."""

    name: str
    preset: str
    runs: tuple[Run, ...]


def read_spec(path: Path) -> Spec:
    """Read and check a whole table: every name, key and value of each run. Raises InputError."""
    if not path.exists():
        raise InputError(f"{path} does not exist; give the .toml file that describes the table.")
    table = read_toml(path)
    known = ("preset", "seeds", "common", "scenes", "rows")
    for key in table:
        if key not in known:
            raise InputError(f"{path}: there is no key {key}{did_you_mean(key, known, f'; known: {_list(known)}.')}")
    preset = table.get("preset")
    if not isinstance(preset, str):
        raise InputError(f"{path}: preset must be the name of a preset, got {shown(preset)}.")
    seeds = _seeds(table.get("seeds"), f"{path}: seeds")
    common = _overrides(table.get("common", {}), f"{path}: common")
    scenes = _scenes(table.get("scenes"), path)

    runs: list[Run] = []
    rows = _named_tables(table.get("rows"), f"{path}: rows")
    if len(scenes) * len(rows) * len(seeds) > MOST_RUNS:
        raise InputError(f"{path}: names more than {MOST_RUNS} runs; make several tables of it.")
    for row, entry in rows.items():
        where = f"{path}: rows.{row}"
        if not isinstance(entry, dict):
            raise InputError(f"{where} must be a table of keys of the configuration, got {shown(entry)}.")
        row_scenes = _subset(entry.pop("scenes", list(scenes)), list(scenes), f"{where}.scenes")
        row_seeds = _subset(_seeds(entry.pop("seeds", seeds), f"{where}.seeds"), seeds, f"{where}.seeds")
        method, ablate = entry.pop("method", None), entry.pop("ablate", [])
        if not isinstance(ablate, list) or not all(isinstance(part, str) for part in ablate):
            raise InputError(f"{where}.ablate must be a list of parts, got {shown(ablate)}.")
        short = shorthands(method, ablate, (f"{where}.method", f"{where}.ablate"))
        entry = _overrides(entry, where)
        for scene in row_scenes:
            folder, own = scenes[scene]
            overrides = merge(merge(common, own), entry)
            for seed in row_seeds:
                where = f"{path}: {scene}, {row}"
                values = merge(overrides, {"seed": seed})
                config = build_config(preset, values, where, short)
                said = overrides | ({"method": method} if method else {}) | ({"ablate": ablate} if ablate else {})
                runs.append(Run(RunKey(scene, row, seed), folder, config, said))
    # Scene by scene, so that a table of which half is made compares all rows on half of the scenes.
    order = list(scenes)
    return Spec(path.stem, preset, tuple(sorted(runs, key=lambda run: order.index(run.key.scene))))


# Keys that are younger than results worth keeping, and the value at which they change nothing: of themselves, or of
# the key that decides whether they do anything.
_YOUNGER: tuple[tuple[str, Any, str], ...] = (
    ("schedule.batch", 1, ""),
    ("antialiased", False, ""),
    ("exposure", False, "exposure.enabled"),
    ("timing", False, "timing.refine"),
    ("discovery", False, "discovery.enabled"),
    ("field.unit", 1, ""),
    ("field.negative_scales", "floor", ""),
    ("density.limit", 0, ""),
    ("density.contribution_interval", 0, "density.min_contribution"),
    ("density.min_contribution", 0, ""),
    ("data.split", "test", ""),
    ("data.masks", "", ""),
    ("data.units", "world", ""),
    ("data.undistort", True, ""),
    ("smoothness.start", 0, ""),
    ("acceleration", 0, "acceleration.weight"),
)


def _at(values: Mapping[str, Any], keys: str) -> Any:
    """The value at dotted keys."""
    for key in keys.split("."):
        values = values[key]
    return values


@lru_cache(maxsize=1)
def _usual_cameras() -> frozenset[CamerasConfig]:
    """How the presets refine cameras."""
    return frozenset(load_config(name).cameras for name in preset_names())


def fingerprint(config: Config) -> str:
    """Of all that the result of a training depends on: not of where its images lie, how often it is saved, or where its
    decoder runs, which changes last bits and follows from the device."""
    values = dataclasses.asdict(config)
    del values["data"]["path"], values["schedule"]["save_interval"], values["eval"], values["decoder"]
    if config.cameras in _usual_cameras():
        del values["cameras"]
    for keys, value, decides in _YOUNGER:
        if _at(values, decides or keys) == value:
            section, _, last = keys.rpartition(".")
            del (values[section] if section else values)[last]
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def _scenes(value: Any, path: Path) -> dict[str, tuple[str, Table]]:
    """Name -> folder and overrides."""
    scenes = {}
    for name, entry in _named_tables(value, f"{path}: scenes").items():
        entry = {"folder": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, dict) or not isinstance(entry.get("folder"), str):
            raise InputError(
                f"{path}: scenes.{name} must be a folder, or a table with the key folder, got {shown(entry)}."
            )
        folder = entry.pop("folder")
        if is_builtin(folder):
            try:
                builtin_folder(folder)  # checks its keys
            except InputError as error:
                raise InputError(f"{path}: scenes.{name}: {error}") from None
        scenes[name] = (folder, _overrides(entry, f"{path}: scenes.{name}"))
    return scenes


def _named_tables(value: Any, where: str) -> Table:
    if not isinstance(value, dict) or not value:
        raise InputError(f"{where} must be a table with at least one entry, got {shown(value)}.")
    for name in value:
        if not _NAME.fullmatch(name):
            raise InputError(f"{where}: {name!r} must be a name of letters, digits, spaces and . + = _ - only.")
        if name.endswith((".", " ")) or name.split(".")[0].rstrip().upper() in _RESERVED:
            raise InputError(f"{where}: {name!r} cannot be the name of a folder on Windows; take another.")
    folders = [name.casefold() for name in value]
    if len(set(folders)) < len(folders):
        same = next(name for name in value if folders.count(name.casefold()) > 1)
        raise InputError(
            f"{where}: {same!r} and another name differ in capital letters alone, and so share a folder on macOS and "
            "Windows; rename one."
        )
    return value


def _overrides(value: Any, where: str) -> Table:
    if not isinstance(value, dict):
        raise InputError(f"{where} must be a table of keys of the configuration, got {shown(value)}.")
    data = value.get("data")
    if "seed" in value or (isinstance(data, dict) and "path" in data):
        raise InputError(f"{where} must set neither seed nor data.path: the keys seeds and scenes do.")
    return value


def _seeds(value: Any, where: str) -> list[int]:
    whole = isinstance(value, list) and all(type(seed) is int and seed >= 0 for seed in value)
    if not whole or not value or len(set(value)) < len(value):
        raise InputError(f"{where} must be a list of different whole numbers from 0 up, got {shown(value)}.")
    return value


def _subset(value: Any, known: list[Any], where: str) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{where} must be a list of {_list(known)}, got {shown(value)}.")
    for entry in value:
        if entry not in known:
            raise InputError(f"{where}: {shown(entry)} is none of {_list(known)}.")
    return [entry for entry in known if entry in value]


def _list(names: Iterable[object]) -> str:
    return ", ".join(map(str, names))
