"""The dataset that a configuration names."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.built_in import SYNTHETIC, write_built_in
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.train.config import Config


def resolve_data(config: Config, scenes: Path) -> Config:
    """The configuration with the absolute paths of its data. scenes: folder into which the built-in scene is written,
    unless it is there. Raises InputError."""
    path = config.data.path
    if not path:
        raise InputError(f"the configuration names no data; give --data DIR (in Python data.path), or {SYNTHETIC}.")
    folder = write_built_in(scenes / SYNTHETIC) if path == SYNTHETIC else Path(path)
    masks = str(Path(config.data.masks).resolve()) if config.data.masks else ""
    return dataclasses.replace(config, data=dataclasses.replace(config.data, path=str(folder.resolve()), masks=masks))


def open_dataset(config: Config) -> Dataset:
    """The dataset of a configuration whose path is a folder's. Raises InputError."""
    data = config.data
    return load_dataset(
        data.path,
        image_size=data.size or None,
        undistort=data.undistort,
        masks=data.masks or None,
        movers=data.movers or None,
    )
