"""Renders the built-in moving scene: toys over a checkered table, ray traced and written out in the D-NeRF layout.

python benchmarks/synthetic.py writes it to lapgs_wgpu/data/synthetic.zip, which the package unpacks (data/built_in).

Every toy moves along an ellipse or a line, or turns, at one frequency of its own, so what a trained model should have
found is known exactly. The scene fits in [-1.3, 1.3]^3, z is up, and the camera jumps about the upper hemisphere from
frame to frame.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal
from zipfile import ZipFile, ZipInfo

import numpy as np
from dnerf_writer import split_times, write_image, write_scene
from numpy.typing import ArrayLike, NDArray
from raytrace import (
    Color,
    Floats,
    Solid,
    Vector,
    combine,
    pixel_rays,
    plane_hits,
    solid_hits,
    to_pixels,
    turn_about_z,
)

from lapgs_wgpu.data.built_in import RECORD
from lapgs_wgpu.splat.camera import Camera

CAMERA_ANGLE_X = 0.6911112070083618  # horizontal field of view in radians, that of D-NeRF's scenes
CAMERA_RADIUS = 4.0
CAMERA_HEIGHT = (0.3, 0.9)  # range of the sine of the camera's elevation
PACKED = Path(__file__).parents[1] / "lapgs_wgpu" / "data" / "synthetic.zip"
VERSION = 1  # of the scene's looks: raise it with every change of what is rendered

TABLE_HEIGHT, TABLE_RADIUS = -0.6, 1.15


@dataclass(frozen=True)
class Toy:
    """A moving thing. Its centre is at `centre + cosine cos(2 pi f t) + sine sin(2 pi f t)`.

    cycles: f, over the clip. radius: of the ball; half the edge of the box. turns: whether it also turns about z, f
    turns over the clip. colors: the two between which its pattern alternates. All in world units, RGB in [0, 1].
    """

    cycles: float
    shape: Literal["beach ball", "ringed ball", "box"]
    radius: float
    centre: Vector
    cosine: Vector
    sine: Vector
    colors: tuple[Color, Color]
    turns: bool = False

    @property
    def solid(self) -> Solid:
        return Solid(self.shape, (self.radius,) * 3, self.colors)

    def path(self, times: ArrayLike) -> Floats:
        """Where its centre is: (T, 3) in world units, for times (T,) in [0, 1]."""
        angle = self.cycles * (2 * np.pi * np.asarray(times, dtype=np.float64)[:, None])
        return np.asarray(np.array(self.centre) + np.cos(angle) * self.cosine + np.sin(angle) * self.sine)


# Each moves by about its own radius, so that the mean over time still shows it: a model that first fits a still scene
# has something to set in motion. Rings run along the fast motion, where segments would alias.
# fmt: off
TOYS = (
    Toy(1.0, "beach ball", 0.40, (0.1, 0.05, 0.55), (0.36, 0, 0), (0, 0.36, 0),
        ((0.92, 0.38, 0.27), (0.98, 0.93, 0.82))),
    Toy(2.0, "beach ball", 0.34, (-0.75, -0.45, 0.12), (0, 0, 0), (0, 0, -0.36),
        ((0.13, 0.58, 0.55), (0.93, 0.77, 0.33))),
    Toy(3.5, "ringed ball", 0.33, (0.66, -0.2, -0.23), (0, 0.3, 0), (0, 0, 0),
        ((0.30, 0.36, 0.78), (0.95, 0.62, 0.75))),
    Toy(0.5, "box", 0.29, (-0.2, 0.62, -0.29), (0, 0, 0), (0, 0, 0),
        ((0.55, 0.27, 0.62), (0.62, 0.80, 0.32)), turns=True),
)
# fmt: on


def render(camera: Camera, time: float, toys: Sequence[Toy] = TOYS) -> NDArray[np.uint8]:
    """Ray trace one picture: (H, W, 4) straight RGBA."""
    rays = pixel_rays(camera)
    surfaces = []
    for toy in toys:
        turn = turn_about_z(2 * np.pi * toy.cycles * time if toy.turns else 0.0)
        surfaces.append(solid_hits(toy.solid, toy.path([time])[0], camera.position, rays, turn=turn))
    surfaces.append(plane_hits(2, TABLE_HEIGHT, 1, _table, camera.position, rays))
    color, owner = combine(surfaces, rays.shape[1])
    return to_pixels(color, owner >= 0, camera)


def _table(x: Floats, y: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """The static disc below: a checkered top with a plain rim."""
    square = x * x + y * y
    inside = square < TABLE_RADIUS**2
    x, y, square = x[inside], y[inside], square[inside]
    light = (np.floor(x / 0.42) + np.floor(y / 0.42)) % 2 == 0
    albedo = np.where(light, np.array([[0.86], [0.83], [0.76]]), np.array([[0.34], [0.42], [0.50]]))
    albedo = np.where(square > (0.9 * TABLE_RADIUS) ** 2, np.array([[0.58], [0.40], [0.27]]), albedo)
    return inside, albedo


def cameras(n: int, seed: int, *, size: int) -> list[Camera]:
    """n cameras on the upper hemisphere that look at the origin: one far from the next, all together well spread."""
    return [
        camera_at(2 * math.pi * turn, CAMERA_HEIGHT[0] + (CAMERA_HEIGHT[1] - CAMERA_HEIGHT[0]) * lift, size=size)
        for turn, lift in jumps(n, seed)
    ]


def jumps(n: int, seed: int) -> Floats:
    """(n, 2) points of the unit square, one far from the next, all together well spread."""
    # Roberts' R2 sequence: multiples of 1/g and 1/g^2 modulo 1, where g^3 = g + 1
    g = 1.324717957244746
    start = np.random.default_rng(seed).random(2)
    return np.array([(start + np.array([i / g, i / g**2])) % 1 for i in range(n)])


def camera_at(azimuth: float, height: float, *, size: int, fov_x: float = CAMERA_ANGLE_X) -> Camera:
    """A camera at CAMERA_RADIUS that looks at the origin. azimuth: radians. height: sine of the elevation."""
    ring = math.sqrt(1 - height * height)
    direction = np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), height])
    return Camera.looking_at(CAMERA_RADIUS * direction, [0, 0, 0], up=[0, 0, 1], fov_x=fov_x, width=size, height=size)


def write_synthetic(
    folder: str | Path,
    *,
    size: int = 128,
    train_views: int = 100,
    test_views: int = 20,
) -> Path:
    """Write the scene as D-NeRF does: transforms_{train,val,test}.json and size x size RGBA PNGs. Returns the folder.

    train_views: spread evenly over the clip, the camera of each elsewhere. test_views: halfway between training times,
    from cameras of their own; as many again for validation.
    The same arguments give the same bytes. A folder that already holds this very scene is left as it is, and one that
    holds anything else is refused with InputError. The folder appears only when it is whole.
    """
    parameters = {"version": VERSION, "size": size, "train_views": train_views, "test_views": test_views}
    train, test = split_times(train_views, test_views)
    splits = {
        split: (cameras(len(times), index, size=size), times)
        for index, (split, times) in enumerate((("train", train), ("val", test), ("test", test)))
    }

    def write_frame(unfinished: Path, split: str, name: str, camera: Camera, time: float) -> None:
        write_image(unfinished / split / f"{name}.png", render(camera, time))

    return write_scene(Path(folder), RECORD, parameters, splits, CAMERA_ANGLE_X, write_frame)


def pack(folder: Path, file: Path) -> None:
    """Write the files of a folder into a zip file, whose bytes depend on nothing else."""
    with ZipFile(file, "w") as packed:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            packed.writestr(ZipInfo(str(path.relative_to(folder))), path.read_bytes())


if __name__ == "__main__":
    with TemporaryDirectory() as made:
        pack(write_synthetic(Path(made) / "scene"), PACKED)
