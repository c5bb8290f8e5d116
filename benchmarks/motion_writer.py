"""Writes motion scenes: python benchmarks/motion_writer.py DIR [path=4,cycles=2 ...] writes each to the folder of
its name in DIR, in the D-NeRF layout; without names, all scenes of docs/tables/motion.toml. A name has the keys of
`MotionScene`. Beside the images lies the ground truth of the moving objects:

objects.json: parameters of the scene; size of each object, and its positions at the times of each split's images.
masks/SPLIT/VIEW_OBJECT.png: pixels of a test image that show a moving object, 8-bit gray, antialiased.
clean/SPLIT/VIEW_OBJECT.png: the image without that object, RGBA.
"""

import dataclasses
import sys
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
from dnerf_writer import split_times, write_image, write_scene
from motion_scenes import GAP, STILL_CAMERAS, MotionScene, fov_x, moving_objects, scene_cameras, trace
from numpy.typing import NDArray
from raytrace import SAMPLES, Hits, combine, pixel_means, to_bytes, to_pixels

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.dataclass_table import build_dataclass
from lapgs_wgpu.splat.camera import Camera

FORMAT = "lapgs-objects 1"
VERSION = 2  # of the rendered images: increase it with every change of them
TABLE = Path(__file__).parents[1] / "docs" / "tables" / "motion.toml"


def parse_motion(name: str) -> MotionScene:
    """The scene that KEY=VALUE,... names. Raises InputError."""
    pairs = [part.partition("=") for part in name.split(",") if part]
    return build_dataclass(MotionScene, {key: value for key, _, value in pairs}, name)


def write_motion(
    folder: str | Path,
    scene: MotionScene,
    *,
    size: int = 200,
    train_times: int | None = None,
    test_views: int = 20,
    seed: int = 0,
) -> Path:
    """Write a scene: training images at equally spaced times without those in gaps, test and validation images halfway
    between two of all.

    Equal arguments give equal bytes. A folder that already holds the scene is not changed.

    Args:
        folder: appears only when it is complete.
        size: of the square images, pixels.
        train_times: number of training times, with one image each, or STILL_CAMERAS images from static cameras. None
            for 120, or 40 with static cameras.
        test_views: number of images of each of the splits test and val.
        seed: of the jumping cameras.

    Returns:
        The folder.

    Raises:
        InputError: bad arguments, a folder that holds anything else, or errors of the file system.
    """
    still = scene.camera == "still"
    if train_times is None:
        train_times = 40 if still else 120
    if size < 1 or train_times < 2 or test_views < 1 or seed < 0:
        raise InputError(
            "a motion scene needs a size of at least 1, 2 training times, 1 test view and a seed from 0 up, "
            f"got {size}, {train_times}, {test_views} and {seed}."
        )
    parameters = {
        "format": FORMAT,
        "version": VERSION,
        "scene": dataclasses.asdict(scene),
        "size": size,
        "train_times": train_times,
        "test_views": test_views,
        "seed": seed,
    }
    train, test = split_times(train_times, test_views)
    times_of = {"train": np.repeat(train, STILL_CAMERAS) if still else train, "val": test, "test": test}
    splits = {split: (scene_cameras(scene, split, times, seed, size=size), times) for split, times in times_of.items()}
    shown = np.isin(times_of["train"], np.delete(train, _gaps(train_times, scene.gaps)))
    times_of["train"] = times_of["train"][shown]
    splits["train"] = [splits["train"][0][i] for i in np.flatnonzero(shown)], times_of["train"]
    objects = [
        {
            "name": one.name,
            "moves": one.moves,
            "shape": one.solid.shape,
            "half": one.solid.half,
            "diameter": one.diameter,
            "turns": one.turns,
            "twists": one.twists,
            "positions": {split: one.positions(times).tolist() for split, times in times_of.items()},
        }
        for one in moving_objects(scene)
    ]
    write_frame = partial(_write_frame, scene)
    return write_scene(
        Path(folder), "objects.json", parameters, splits, fov_x(scene), write_frame, {"objects": objects}
    )


def _gaps(times: int, gaps: int) -> list[int]:
    """The training times without an image, in blocks that are spread over the clip."""
    return [k * (times // (gaps + 1)) + i for k in range(1, gaps + 1) for i in range(GAP)]


def _write_frame(scene: MotionScene, folder: Path, split: str, name: str, camera: Camera, time: float) -> None:
    """Write an image; for test and validation also the mask and the clean plate of each moving object."""
    surfaces = trace(scene, camera, time)
    count = camera.width * camera.height * SAMPLES**2

    def image(hits: list[Hits]) -> NDArray[np.uint8]:
        color, owner = combine(hits, count)
        return to_pixels(color, owner >= 0, camera)

    write_image(folder / split / f"{name}.png", image(surfaces))
    if split == "train":
        return
    _, owner = combine(surfaces, count)
    for number, one in enumerate(moving_objects(scene)):
        if one.moves:
            file = f"{split}/{name}_{one.name}.png"
            write_image(folder / "masks" / file, to_bytes(pixel_means(owner == number, camera)))
            write_image(folder / "clean" / file, image([*surfaces[:number], *surfaces[number + 1 :]]))


if __name__ == "__main__":
    parent, *names = sys.argv[1:]
    for name in names or tomllib.loads(TABLE.read_text())["scenes"].values():
        name = name if isinstance(name, str) else name["folder"]
        print(write_motion(Path(parent, name), parse_motion(name)))
