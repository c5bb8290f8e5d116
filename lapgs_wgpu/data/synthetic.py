"""The built-in moving scene: toys over a checkered table, ray traced and written out in the D-NeRF layout.

Every toy moves along an ellipse or a line, or turns, at one frequency of its own, so what a trained model should have
found is known exactly. The scene fits in [-1.3, 1.3]^3, z is up, and the camera jumps about the upper hemisphere from
frame to frame.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

Floats = NDArray[np.float64]
Colour = tuple[float, float, float]

FREQUENCIES = (1.0, 2.0, 3.5, 0.5)  # cycles over the clip, of the toys in their order
CAMERA_ANGLE_X = 0.6911112070083618  # horizontal field of view in radians, that of D-NeRF's scenes
CAMERA_RADIUS = 4.0
CAMERA_HEIGHT = (0.3, 0.9)  # range of the sine of the camera's elevation
VERSION = 1  # of the scene's looks: raise it with every change of what is rendered
SAMPLES = 3  # a pixel is the mean of SAMPLES x SAMPLES rays

TABLE_HEIGHT, TABLE_RADIUS = -0.6, 1.15
LIGHT = np.array([0.30, -0.35, 0.887])  # unit vector towards the light
AMBIENT, SKY, DIFFUSE = 0.42, 0.13, 0.45  # sum to 1; SKY: how much more light comes from above than from the side


@dataclass(frozen=True)
class Toy:
    """A moving thing. Its centre is at `centre + cosine cos(2 pi f t) + sine sin(2 pi f t)`.

    radius: of the ball; half the edge of the box. turns: whether it also turns about z, f turns over the clip.
    colours: the two between which its pattern alternates. All in world units, RGB in [0, 1].
    """

    name: str
    shape: Literal["beach ball", "ringed ball", "box"]
    radius: float
    centre: tuple[float, float, float]
    cosine: tuple[float, float, float]
    sine: tuple[float, float, float]
    colours: tuple[Colour, Colour]
    turns: bool = False


# Each moves by about its own radius, so that the mean over time still shows it: a model that first fits a still scene
# has something to set in motion. Rings run along the fast motion, where segments would alias.
# fmt: off
TOYS = (
    Toy("orbiter", "beach ball", 0.40, (0.1, 0.05, 0.55), (0.36, 0, 0), (0, 0.36, 0),
        ((0.92, 0.38, 0.27), (0.98, 0.93, 0.82))),
    Toy("bouncer", "beach ball", 0.34, (-0.75, -0.45, 0.12), (0, 0, 0), (0, 0, -0.36),
        ((0.13, 0.58, 0.55), (0.93, 0.77, 0.33))),
    Toy("shuttle", "ringed ball", 0.33, (0.66, -0.2, -0.23), (0, 0.3, 0), (0, 0, 0),
        ((0.30, 0.36, 0.78), (0.95, 0.62, 0.75))),
    Toy("spinner", "box", 0.29, (-0.2, 0.62, -0.29), (0, 0, 0), (0, 0, 0),
        ((0.55, 0.27, 0.62), (0.62, 0.80, 0.32)), turns=True),
)
# fmt: on


def trajectories(times: ArrayLike, frequencies: Sequence[float] = FREQUENCIES) -> dict[str, Floats]:
    """Where the toys' centres are: name -> (T, 3) in world units, for times (T,) in [0, 1]."""
    phase = 2 * np.pi * np.asarray(times, dtype=np.float64)[:, None]
    return {
        toy.name: np.array(toy.centre) + np.cos(f * phase) * toy.cosine + np.sin(f * phase) * toy.sine
        for toy, f in zip(TOYS, frequencies, strict=False)
    }


def render(camera: Camera, time: float, frequencies: Sequence[float] = FREQUENCIES) -> NDArray[np.uint8]:
    """Ray trace one picture: (H, W, 4) straight RGBA."""
    n = SAMPLES
    x = (np.arange(camera.width * n) + 0.5) / n
    y = (np.arange(camera.height * n) + 0.5) / n
    K, R = camera.K, camera.T_cam_world[:3, :3]
    u, v = np.meshgrid((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1])
    # Sums are written out, here and below: a matrix product may round differently on another machine.
    rays = np.stack([(R[0, i] * u + R[1, i] * v + R[2, i]).ravel() for i in range(3)])
    rays /= np.sqrt(_dot(rays, rays))

    nearest = np.full(rays.shape[1], np.inf)
    colour = np.zeros_like(rays)
    centres = trajectories([time], frequencies)
    for toy, f in zip(TOYS, frequencies, strict=False):
        angle = 2 * np.pi * f * time if toy.turns else 0.0
        _draw_toy(toy, centres[toy.name][0], angle, camera.position, rays, nearest, colour)
    _draw_table(camera.position, rays, nearest, colour)

    rgba = np.concatenate([colour, np.isfinite(nearest)[None]]).reshape(4, camera.height, n, camera.width, n)
    rgba = rgba.mean(axis=(2, 4))
    rgba[:3] /= np.maximum(rgba[3], 1e-9)  # so far colours are premultiplied by the share of rays that hit
    return np.floor(np.moveaxis(rgba, 0, 2) * 255 + 0.5).astype(np.uint8)


def _dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _turned(p: Floats, angle: float) -> Floats:
    """Vectors (3, ...) rotated about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.stack([c * p[0] - s * p[1], s * p[0] + c * p[1], p[2]])


def _lit(albedo: Floats, normal: Floats) -> Floats:
    """Diffuse shading: albedo (3, n), unit normals (3, n) -> colours (3, n)."""
    return albedo * (AMBIENT + SKY * normal[2] + DIFFUSE * np.maximum(_dot(normal, LIGHT), 0))


def _draw_toy(
    toy: Toy, centre: Floats, angle: float, eye: Floats, rays: Floats, nearest: Floats, colour: Floats
) -> None:
    """Where rays (3, n) meet the toy first, update `nearest` (n,), the distance along the ray, and `colour` (3, n)."""
    to_eye = eye - centre
    along = -_dot(rays, to_eye)
    beside = _dot(to_eye, to_eye) - along**2  # squared distance at which a ray passes the centre
    near = np.flatnonzero(beside < toy.radius**2 * (3 if toy.shape == "box" else 1))
    origin, d = _turned(to_eye, -angle), _turned(rays[:, near], -angle)
    if toy.shape == "box":
        with np.errstate(divide="ignore", invalid="ignore"):
            entry = ((-np.sign(d) * toy.radius - origin[:, None]) / d).max(axis=0)
            leave = ((np.sign(d) * toy.radius - origin[:, None]) / d).min(axis=0)
        distance = np.where(entry < leave, entry, np.inf)
    else:
        distance = along[near] - np.sqrt(toy.radius**2 - beside[near])
    first = distance < nearest[near]
    hit, d, distance = near[first], d[:, first], distance[first]

    p = (origin[:, None] + distance * d) / toy.radius
    if toy.shape == "box":  # one half of each colour, and a belt of the other
        normal = np.where(np.arange(3)[:, None] == np.argmax(np.abs(p), axis=0), np.sign(p), 0.0)
        pattern = (p[0] > 0) != (np.abs(p[2]) < 0.35)
    else:
        normal = p
        if toy.shape == "beach ball":  # six segments, and caps of one colour
            pattern = (np.floor(np.arctan2(p[1], p[0]) * (3 / np.pi)) % 2 == 0) | (np.abs(p[2]) > 0.88)
        else:
            pattern = np.floor(p[2] * 2 + 0.5) % 2 == 0
    one, other = np.array(toy.colours)[:, :, None]
    colour[:, hit] = _lit(np.where(pattern, one, other), _turned(normal, angle))
    nearest[hit] = distance


def _draw_table(eye: Floats, rays: Floats, nearest: Floats, colour: Floats) -> None:
    """The same as `_draw_toy` for the static disc below, seen from above only: a checkered top with a plain rim."""
    down = np.flatnonzero(rays[2] < 0)
    distance = (TABLE_HEIGHT - eye[2]) / rays[2, down]
    x, y = eye[:2, None] + distance * rays[:2, down]
    square = x * x + y * y
    seen = (square < TABLE_RADIUS**2) & (distance < nearest[down])
    hit, x, y, square = down[seen], x[seen], y[seen], square[seen]
    light = (np.floor(x / 0.42) + np.floor(y / 0.42)) % 2 == 0
    albedo = np.where(light, np.array([[0.86], [0.83], [0.76]]), np.array([[0.34], [0.42], [0.50]]))
    albedo = np.where(square > (0.9 * TABLE_RADIUS) ** 2, np.array([[0.58], [0.40], [0.27]]), albedo)
    colour[:, hit] = _lit(albedo, np.array([0.0, 0.0, 1.0])[:, None].repeat(len(hit), axis=1))
    nearest[hit] = distance[seen]


def cameras(n: int, seed: int, *, size: int) -> list[Camera]:
    """n cameras on the upper hemisphere that look at the origin: one far from the next, all together well spread."""
    # Roberts' R2 sequence: multiples of 1/g and 1/g^2 modulo 1, where g^3 = g + 1
    g = 1.324717957244746
    start = np.random.default_rng(seed).random(2)
    low, high = CAMERA_HEIGHT
    result = []
    for i in range(n):
        turn, lift = (start + np.array([i / g, i / g**2])) % 1
        z = low + (high - low) * lift
        ring = math.sqrt(1 - z * z)
        direction = np.array([ring * math.cos(2 * math.pi * turn), ring * math.sin(2 * math.pi * turn), z])
        result.append(
            Camera.looking_at(
                CAMERA_RADIUS * direction, [0, 0, 0], up=[0, 0, 1], fov_x=CAMERA_ANGLE_X, width=size, height=size
            )
        )
    return result


def write_synthetic(
    folder: str | Path,
    *,
    size: int = 128,
    train_views: int = 100,
    test_views: int = 20,
    seed: int = 0,
    frequencies: Sequence[float] = FREQUENCIES,
) -> Path:
    """Write the scene as D-NeRF does: transforms_{train,val,test}.json and size x size RGBA PNGs. Returns the folder.

    train_views: spread evenly over the clip, the camera of each elsewhere. test_views: halfway between training times,
    from cameras of their own; as many again for validation. seed: of the cameras.
    frequencies: cycles over the clip of the first toys; there are as many toys as frequencies, at most 4.
    The same arguments give the same bytes. A folder that already holds this very scene is left as it is, and one that
    holds anything else is refused with InputError. The folder appears only when it is whole.
    """
    if size < 1 or train_views < 2 or test_views < 1 or seed < 0:
        raise InputError(
            "the built-in scene needs a size of at least 1, 2 training views, 1 test view and a seed from 0 up, "
            f"got {size}, {train_views}, {test_views} and {seed}."
        )
    if not 1 <= len(frequencies) <= len(TOYS) or not all(math.isfinite(f) and f >= 0 for f in frequencies):
        raise InputError(f"the built-in scene needs 1 to {len(TOYS)} frequencies from 0 up, got {list(frequencies)}.")
    folder = Path(folder)
    parameters = {
        "version": VERSION,
        "size": size,
        "train_views": train_views,
        "test_views": test_views,
        "seed": seed,
        "frequencies": [float(f) for f in frequencies],
    }
    if _already_holds(folder, parameters):
        return folder

    ends = np.linspace(0, 1, train_views)
    between = (np.floor((np.arange(test_views) + 0.5) / test_views * (train_views - 1)) + 0.5) / (train_views - 1)
    unfinished = folder.with_name(f"{folder.name}.{os.getpid()}.partial")
    try:
        for index, (split, times) in enumerate((("train", ends), ("val", between), ("test", between))):
            (unfinished / split).mkdir(parents=True)
            frames = []
            for i, (camera, time) in enumerate(
                zip(cameras(len(times), 3 * seed + index, size=size), times, strict=True)
            ):
                name = f"{split}/r_{i:03d}"
                Image.fromarray(render(camera, time, frequencies)).save(unfinished / f"{name}.png")
                T_world_cam = np.eye(4)
                T_world_cam[:3, :3] = camera.T_cam_world[:3, :3].T * [1, -1, -1]  # OpenGL's axes: y up, z backward
                T_world_cam[:3, 3] = camera.position
                frames.append({"file_path": f"./{name}", "time": time, "transform_matrix": T_world_cam.tolist()})
            data = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
            (unfinished / f"transforms_{split}.json").write_text(json.dumps(data, indent=1) + "\n")
        (unfinished / "synthetic.json").write_text(json.dumps(parameters, indent=1) + "\n")
        if folder.is_dir():
            folder.rmdir()  # it is empty
        unfinished.rename(folder)
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error}.") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return folder


def _already_holds(folder: Path, parameters: dict[str, object]) -> bool:
    """Whether the folder holds the scene of these parameters; InputError where it holds something else."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        found = json.loads((folder / "synthetic.json").read_text())
    except (OSError, ValueError):
        found = None
    if found == parameters:
        return True
    what = "is not empty"
    if isinstance(found, dict):
        other = [
            f"{key} {found.get(key)} instead of {value}" for key, value in parameters.items() if found.get(key) != value
        ]
        what = f"holds another built-in scene ({', '.join(other)})"
    raise InputError(
        f"{folder} {what} and is left alone; name another folder for the built-in scene, or remove this one."
    )
