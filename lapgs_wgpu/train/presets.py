"""Presets: configurations in TOML, by name or from a file, with values overridden from the command line.

A file names every key, or starts from another preset (`base = "dnerf"`) and names what differs.
"""

import dataclasses
import functools
import importlib.resources
import json
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.io.dataclass_table import build_dataclass, checked, did_you_mean, field_types
from lapgs_wgpu.io.safe_json_toml import read_toml
from lapgs_wgpu.motion.fields.config import Method
from lapgs_wgpu.train.config import Config

Table = dict[str, Any]
# The paper's parts beside its field: off for every other method.
PAPER_ONLY = {"loss.pyramid": 0.0, "loss.ncc": 0.0, "density.split": "plain"}
# The parts of the method that --ablate turns off: help text, key, and value of the key without the part.
ABLATIONS: dict[str, tuple[str, str, Any]] = {
    "laplacian": ("motion spectrum, replaced by an MLP", "field.motion", "mlp"),
    "dynamics": ("dynamics attributes", "field.dynamics", 0),
    "split": ("adaptive split", "density.split", "plain"),
    "lap": ("Laplacian pyramid loss", "loss.pyramid", 0.0),
    "ncc": ("cross-correlation loss", "loss.ncc", 0.0),
    "dy": ("dynamics regularization", "loss.dynamics", 0.0),
    "hash": ("space-time hash grids", "field.temporal_hash", False),
    "appearance": ("color changes over time", "field.appearance", "none"),
}


def preset_names() -> list[str]:
    """The presets that come with the package."""
    return sorted(name for name in _packaged() if not name.startswith("_"))


def load_config(
    preset: str | os.PathLike[str],
    overrides: Mapping[str, Any] | None = None,
    *,
    method: str | None = None,
    ablate: Iterable[str] = (),
) -> Config:
    """A preset by name, or a .toml file by path (such as an earlier run's config.toml), with some values overridden.

    Args:
        preset: name or path.
        overrides: values by dotted key, such as `schedule.steps`; texts are read as on the command line. Applied last.
        method: a field's kind (`--field`); the losses and the split of the paper's method are then left out.
        ablate: parts of the paper's method that are left out (`--ablate`).

    Returns:
        A frozen dataclass: `config.schedule.steps`. `dataclasses.replace` changes it.

    Raises:
        InputError: the preset, a key or a value is not valid.
    """
    preset = os.fspath(preset)
    known = config_keys()
    base = _read(preset)
    for key, value in {**_shorthands(method, ablate), **(overrides or {})}.items():
        if key not in known:
            raise InputError(f"there is no key {key!r}{did_you_mean(key, known)}")
        for part in reversed(key.split(".")):
            value = {part: value}
        base = _merge(base, value)
    return build_dataclass(Config, base, preset, advice='; add it, or start the file with base = "dnerf"')


def _shorthands(method: str | None, ablate: Iterable[str]) -> dict[str, Any]:
    """Key of the configuration -> value of what `method` and `ablate` of `load_config` stand for."""
    values: dict[str, Any] = {}
    if method is not None:
        values["field.kind"] = checked(Method, method, "method")
        values |= PAPER_ONLY if method != "laplacian" else {}
    for part in ablate:
        if part not in ABLATIONS:
            raise InputError(f"ablate knows {', '.join(ABLATIONS)}, not {shown(part)}{did_you_mean(part, ABLATIONS)}")
        if method not in (None, "laplacian") and (method, part) != ("grid4d", "hash"):
            raise InputError(f"ablate {part}: only the method laplacian has this part, not {method}.")
        _, key, value = ABLATIONS[part]
        values[key] = value
    return values


def config_keys(cls: Any = Config, prefix: str = "", said: str = "") -> dict[str, tuple[Any, str]]:
    """Dotted name of every key of the configuration -> its type and its help. prefix, said: before those of `cls`."""
    keys: dict[str, tuple[Any, str]] = {}
    for name, kind in field_types(cls).items():
        text = ": ".join(filter(None, (said, cls.__dataclass_fields__[name].metadata.get("help"))))
        inner = dataclasses.is_dataclass(kind)
        keys |= config_keys(kind, f"{prefix}{name}.", text) if inner else {f"{prefix}{name}": (kind, text)}
    return keys


def write_toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """TOML text of nested dictionaries of texts, numbers, truth values and tuples. prefix: of their names."""
    values, tables = "", ""
    for key, value in table.items():
        if isinstance(value, Mapping):
            tables += f"\n[{prefix}{key}]\n{write_toml(value, f'{prefix}{key}.')}"
        else:  # what JSON writes is TOML, but for one character
            values += f"{key} = {json.dumps(value, ensure_ascii=False)}\n".replace("\x7f", "\\u007f")
    return values + tables


def _read(preset: str, seen: tuple[str, ...] = ()) -> Table:
    """The table of a preset, laid over its base's."""
    if preset in seen:
        raise InputError(f"{preset}: its base leads back to itself ({' -> '.join((*seen, preset))}).")
    if preset.endswith(".toml"):
        if not Path(preset).is_file():
            raise InputError(f"{preset} does not exist; give a preset ({', '.join(preset_names())}) or a .toml file.")
        table = read_toml(Path(preset))
        of_a_run = table.pop("record", None) is not None  # which an earlier version may have written
        if of_a_run and (gone := _remove_unknown(table, Config)):
            print(f"note: {preset}: ignores {', '.join(gone)}, which this version does not know.", file=sys.stderr)
    elif preset in _packaged():
        table = dict(_packaged()[preset])
    else:
        hint = did_you_mean(preset, preset_names(), f"; there are {', '.join(preset_names())}, or give a .toml file.")
        raise InputError(f"there is no preset {preset!r}{hint}")
    base = table.pop("base", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise InputError(f"{preset}: base must be the name of a preset, got {shown(base)}.")
    return _merge(_read(base, (*seen, preset)), table)


@functools.cache
def _packaged() -> dict[str, Table]:
    """The tables of configs/ by name. No caller changes them."""
    folder = Path(str(importlib.resources.files("lapgs_wgpu.configs")))
    presets = {file.stem: read_toml(file) for file in folder.glob("*.toml")}
    return presets | presets.pop("published-scenes")  # each table of which is a preset


def _remove_unknown(table: Table, cls: type, prefix: str = "") -> list[str]:
    """Remove the keys from a nested table that a dataclass lacks; their dotted names."""
    types, gone = field_types(cls), []
    for name, value in list(table.items()):
        if name not in (*types, "base"):
            del table[name]
            gone.append(f"{prefix}{name}")
        elif isinstance(value, dict) and dataclasses.is_dataclass(types.get(name)):
            gone += _remove_unknown(value, types[name], f"{prefix}{name}.")
    return gone


def _merge(below: Any, above: Any) -> Any:
    """A nested table with another one laid over it, of other values the one above."""
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    return below | {key: _merge(below.get(key), value) for key, value in above.items()}
