"""Damage to a capture's files, and the sentence that must refuse it."""

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError

Damage = Callable[[Path], object]  # of a folder
GONE = object()


def refused(folder: Path, *named: str) -> None:
    """Opening a capture ends in one line that names these files, fields and values."""
    with pytest.raises(InputError) as caught:
        load_dataset(folder)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 5500
    assert not [name for name in named if name not in message], message


def put(file: str, *place: Any) -> Damage:
    """Another value in a JSON file: the keys that lead to it, and the value; GONE removes it."""

    def change(folder: Path) -> None:
        path = next(folder.glob(file))
        data = json.loads(path.read_text())
        *keys, last, value = place
        holder = data
        for key in keys:
            holder = holder[key]
        if value is GONE:
            del holder[last]
        else:
            holder[last] = value
        path.write_text(json.dumps(data))

    return change


def text(file: str, content: str | bytes) -> Damage:
    return lambda folder: (folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())


def gone(*files: str) -> Damage:
    def change(folder: Path) -> None:
        for file in files:
            shutil.rmtree(folder / file) if (folder / file).is_dir() else (folder / file).unlink()

    return change


def replaced(file: str, old: str | bytes, new: str | bytes) -> Damage:
    """Other bytes instead of the first ones like `old`."""

    def change(folder: Path) -> None:
        one, other = (part if isinstance(part, bytes) else part.encode() for part in (old, new))
        data = (folder / file).read_bytes()
        assert one in data
        (folder / file).write_bytes(data.replace(one, other, 1))

    return change


def word(file: str, row: int, column: int, new: str) -> Damage:
    """Another word in a text file, by its line and place; "" removes it."""

    def change(folder: Path) -> None:
        lines = (folder / file).read_text().split("\n")
        words = lines[row].split(" ")
        words[column : column + 1] = [new] if new else []
        lines[row] = " ".join(words)
        (folder / file).write_text("\n".join(lines))

    return change


def image(file: str, size: tuple[int, int], mode: str = "RGB") -> Damage:
    return lambda folder: Image.new(mode, size).save(folder / file)


def array(file: str, value: Any) -> Damage:
    return lambda folder: np.save(folder / file, value)


def rows(file: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Another array, made of the one in the file."""
    return lambda folder: np.save(folder / file, change(np.load(folder / file)))


def item(file: str, row: int, column: int | slice, value: Any) -> Damage:
    """Another value in an array."""

    def change(values: np.ndarray) -> np.ndarray:
        values[row, column] = value
        return values

    return rows(file, change)


def claimed_size(file: str, side: int) -> Damage:
    """Let a PNG's header claim so many pixels a side."""

    def change(folder: Path) -> None:
        data = (folder / file).read_bytes()
        header = b"IHDR" + struct.pack(">II", side, side) + data[24:29]
        (folder / file).write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])

    return change
