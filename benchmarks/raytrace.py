"""A small ray tracer for the built-in scenes: textured balls and boxes, diffuse light, antialiased RGBA.

A renderer traces each surface on its own (`solid_hits`, `plane_hits`) and combines any subset of the hits (`combine`).
The same arguments give the same bytes on every machine.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.splat.camera import Camera

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Vector = tuple[float, float, float]
Color = tuple[float, float, float]

SAMPLES = 3  # a pixel is the mean of SAMPLES x SAMPLES rays
UPRIGHT = np.eye(3)  # no turn
LIGHT = np.array([0.30, -0.35, 0.887])  # unit vector towards the light
AMBIENT, SKY, DIFFUSE = 0.42, 0.13, 0.45  # sum to 1; SKY: how much more light comes from above than from the side


@dataclass(frozen=True)
class Solid:
    """A textured ball or box around its own centre.

    half: half of its size along each axis, world units; three equal numbers for a ball.
    colors: the two between which its pattern alternates, RGB in [0, 1].
    """

    shape: Literal["beach ball", "ringed ball", "box"]
    half: Vector
    colors: tuple[Color, Color]


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet one surface: index (n,) of the rays, distance (n,) along them, color (3, n) there."""

    index: Ints
    distance: Floats
    color: Floats


def pixel_rays(camera: Camera) -> Floats:
    """Unit directions (3, N) of all rays of an image: N = (SAMPLES height) (SAMPLES width), row by row."""
    x = (np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES
    y = (np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES
    K, R = camera.K, camera.T_cam_world[:3, :3]
    u, v = np.meshgrid((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1])
    # Sums are written out, here and below: a matrix product may round differently on another machine.
    rays = np.stack([(R[0, i] * u + R[1, i] * v + R[2, i]).ravel() for i in range(3)])
    rays /= np.sqrt(dot(rays, rays))
    return rays


def solid_hits(
    solid: Solid, centre: Floats, eye: Floats, rays: Floats, *, turn: Floats = UPRIGHT, among: Ints | None = None
) -> Hits:
    """Where rays (3, N) from `eye` first meet a solid.

    turn: (3, 3) rotation of the solid about its centre. among: indices of the rays that can meet it; None for all.
    """
    half = np.array(solid.half)
    if among is not None:
        rays = rays[:, among]
    to_eye = eye - centre
    along = -dot(rays, to_eye)
    beside = dot(to_eye, to_eye) - along**2  # squared distance at which a ray passes the centre
    near = np.flatnonzero(beside < (half @ half if solid.shape == "box" else half[0] ** 2))
    origin, d = _turned(to_eye, turn.T), _turned(rays[:, near], turn.T)
    if solid.shape == "box":
        with np.errstate(divide="ignore", invalid="ignore"):
            entry = ((-np.sign(d) * half[:, None] - origin[:, None]) / d).max(axis=0)
            leave = ((np.sign(d) * half[:, None] - origin[:, None]) / d).min(axis=0)
        distance = np.where(entry < leave, entry, np.inf)
    else:
        distance = along[near] - np.sqrt(half[0] ** 2 - beside[near])
    met = np.isfinite(distance) & (distance > 0)
    near, d, distance = near[met], d[:, met], distance[met]

    p = (origin[:, None] + distance * d) / half[:, None]
    if solid.shape == "box":  # one half of each color, and a belt of the other
        normal = np.where(np.arange(3)[:, None] == np.argmax(np.abs(p), axis=0), np.sign(p), 0.0)
        pattern = (p[0] > 0) != (np.abs(p[2]) < 0.35)
    else:
        normal = p
        if solid.shape == "beach ball":  # six segments, and caps of one color
            pattern = (np.floor(np.arctan2(p[1], p[0]) * (3 / np.pi)) % 2 == 0) | (np.abs(p[2]) > 0.88)
        else:
            pattern = np.floor(p[2] * 2 + 0.5) % 2 == 0
    one, other = np.array(solid.colors)[:, :, None]
    color = _lit(np.where(pattern, one, other), _turned(normal, turn))
    return Hits(near if among is None else among[near], distance, color)


def plane_hits(
    axis: int, at: float, facing: int, albedo: Callable[[Floats, Floats], tuple[NDArray[np.bool_], Floats]],
    eye: Floats, rays: Floats,
) -> Hits:  # fmt: skip
    """Where rays (3, N) meet the plane on which coordinate `axis` is `at`, from the side of its normal only.

    facing: 1 or -1, the normal's direction along the axis. albedo: of the two other coordinates (n,) of the points, in
    their order: which belong to the surface (n,), and the colors (3, k) of those k that do.
    """
    towards = np.flatnonzero(rays[axis] * facing < 0)
    distance = (at - eye[axis]) / rays[axis, towards]
    a, b = (i for i in range(3) if i != axis)
    inside, colors = albedo(eye[a] + distance * rays[a, towards], eye[b] + distance * rays[b, towards])
    normal = np.zeros((3, colors.shape[1]))
    normal[axis] = facing
    return Hits(towards[inside], distance[inside], _lit(colors, normal))


def combine(surfaces: Sequence[Hits], count: int) -> tuple[Floats, NDArray[np.int64]]:
    """The nearest surface along each of `count` rays: its color (3, count), 0 where there is none, and its number
    (count,) in `surfaces`, -1 where there is none."""
    nearest = np.full(count, np.inf)
    color = np.zeros((3, count))
    owner = np.full(count, -1)
    for number, hits in enumerate(surfaces):
        first = hits.distance < nearest[hits.index]
        index = hits.index[first]
        nearest[index] = hits.distance[first]
        color[:, index] = hits.color[:, first]
        owner[index] = number
    return color, owner


def to_pixels(color: Floats, hit: NDArray[np.bool_], camera: Camera) -> NDArray[np.uint8]:
    """Average the rays of each pixel: colors (3, N) and whether a ray hit anything (N,) -> (H, W, 4) straight RGBA."""
    rgba = pixel_means(np.concatenate([color, hit[None]]), camera)
    rgba[:3] /= np.maximum(rgba[3], 1e-9)  # so far colors are premultiplied by the share of rays that hit
    return to_bytes(np.moveaxis(rgba, 0, 2))


def pixel_means(values: Floats | NDArray[np.bool_], camera: Camera) -> Floats:
    """Means over the rays of each pixel: (..., N) -> (..., H, W)."""
    shape = (*values.shape[:-1], camera.height, SAMPLES, camera.width, SAMPLES)
    return values.reshape(shape).mean(axis=(-3, -1))


def to_bytes(values: Floats) -> NDArray[np.uint8]:
    """Values in [0, 1], rounded to the nearest 8-bit value."""
    return np.floor(values * 255 + 0.5).astype(np.uint8)


def dot(a: Floats, b: Floats) -> Floats:
    """Dot products of vectors (3, ...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def turn_about_z(angle: float) -> Floats:
    """(3, 3) rotation by an angle, radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _turned(p: Floats, turn: Floats) -> Floats:
    """Vectors (3, ...), rotated."""
    return np.stack([row[0] * p[0] + row[1] * p[1] + row[2] * p[2] for row in turn])


def _lit(albedo: Floats, normal: Floats) -> Floats:
    """Diffuse shading: albedo (3, n), unit normals (3, n) -> colors (3, n)."""
    return albedo * (AMBIENT + SKY * normal[2] + DIFFUSE * np.maximum(dot(normal, LIGHT), 0))
