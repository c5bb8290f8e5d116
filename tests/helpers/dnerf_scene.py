"""A D-NeRF scene on the disk."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOV_X = 12, 8, 0.7
Scene = dict[str, Any]  # split -> the transforms file's object


def camera_to_world(turn: float) -> list[list[float]]:
    """A camera at distance 4 from the origin that looks at it, in OpenGL axes, turned about z."""
    c, s = math.cos(turn), math.sin(turn)
    return [[-s, 0, c, 4 * c], [c, 0, s, 4 * s], [0, 1, 0, 0], [0, 0, 0, 1]]


def make_scene(folder: Path, change: Callable[[Path, Scene], None] | None = None, *, mode: str = "RGBA") -> Path:
    """Write a scene of 3 training views and 1 test view of random pixels, then let `change` spoil it."""
    rng = np.random.default_rng(0)
    scene: Scene = {}
    for split, count in (("train", 3), ("test", 1)):
        (folder / split).mkdir(parents=True)
        frames: list[dict[str, Any]] = []
        for i in range(count):
            pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 4 if mode == "RGBA" else 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / split / f"r_{i:03d}.png")
            frames.append({"file_path": f"./{split}/r_{i:03d}", "transform_matrix": camera_to_world(i)})
        for i, frame in enumerate(frames):
            frame["time"] = (i + 0.5) / count
        scene[split] = {"camera_angle_x": FOV_X, "frames": frames}
    if change:
        change(folder, scene)
    for split, data in scene.items():
        (folder / f"transforms_{split}.json").write_text(data if isinstance(data, str) else json.dumps(data))
    return folder
