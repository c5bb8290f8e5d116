"""How captures of own footage are understood: layouts, names, times, and what is left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from helpers.captures import HEIGHT, WIDTH, Blobs, cameras, write_model
from PIL import Image

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.views import Dataset

POINTS = Blobs.random().means.double().numpy()


def write(
    folder: Path, files: Sequence[str], pose: Callable[[int], int] | None = None, named: Sequence[str] = ()
) -> Path:
    """A COLMAP capture of text. pose: which of 12 cameras took each file. named: the model's names, if others."""
    rng = np.random.default_rng(0)
    for file in files:
        (folder / "images" / file).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)).save(folder / "images" / file)
    taken = cameras(12)
    poses = {name: taken[pose(i) if pose else i % 12] for i, name in enumerate(named or files)}
    intrinsics = [70, WIDTH / 2, HEIGHT / 2]
    colors = np.zeros((len(POINTS), 3), np.uint8)
    write_model(folder / "sparse/0", "SIMPLE_PINHOLE", (WIDTH, HEIGHT), intrinsics, poses, POINTS, colors, binary=False)
    return folder


def times_of(data: Dataset) -> dict[str, float]:
    return {view.source.split("/images/")[-1]: view.time for view in (*data.train, *data.test)}


def test_images_of_a_model_without_blank_lines(tmp_path: Path) -> None:
    folder = write(tmp_path / "toy", [f"{i:04d}.png" for i in range(12)])
    path = folder / "sparse/0/images.txt"
    path.write_text("\n".join(line for line in path.read_text().split("\n") if "#" in line or ".png" in line))
    assert len(times_of(load_dataset(folder))) == 12
