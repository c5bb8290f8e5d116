"""Scenes that measure motion: two objects travel along known paths.

A ball moves along a circle and a box along a line. Both paths are `path` diameters wide and travelled `cycles` times
over the clip. A small ball below them is static. z is up. All objects stay within [-1.3, 1.3]^3 and within the view of
all cameras, unless `objects` says otherwise, so their size depends on the path. `motion_writer` writes
a scene in the D-NeRF layout, with the true paths, masks and clean plates of the objects.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from raytrace import (
    SAMPLES,
    Floats,
    Hits,
    Ints,
    Solid,
    Vector,
    pixel_rays,
    plane_hits,
    solid_hits,
    turn_about_z,
)
from synthetic import camera_at, jumps

from lapgs_wgpu.io.dataclass_table import Options, option
from lapgs_wgpu.splat.camera import Camera

CameraMotion = Literal["jump", "walk", "still"]
Backdrop = Literal["black", "white", "room"]
ObjectSet = Literal["two", "enter", "occluded", "twins", "rods"]

FOV_X, ROOM_FOV_X = 0.69, 0.6  # horizontal field of view of all cameras, radians; in the room
STILL_CAMERAS = 6  # that take the training images of camera="still"
WALK_AZIMUTH, ROOM_AZIMUTH = 2.1, 0.87  # radians that a walk covers; in the room, all cameras
ROOM_CENTRE = -math.pi / 4  # azimuth of the room's cameras, which look into the corner of its two walls
JUMP_HEIGHT, ROOM_HEIGHT = (0.3, 0.9), (0.38, 0.6)  # ranges of the sine of a camera's elevation
ENTER_JUMP_HEIGHT = (0.3, 0.6)  # of objects="enter": the box comes from above, where no camera may be
WALK_HEIGHT, WALK_BOB = 0.47, 0.05  # mean and amplitude of a walk's
FLOOR, WALL = -1.05, 1.3  # z of the room's floor; distance of its walls from the origin, and their height
ENTER_HEIGHT, ENTER_TIMES = 2.3, (0.3, 0.5)  # the box drops into the scene from this much above its path
TILT = 0.6  # radians; of the axis of what turns
RODS = 1 / 4, 1 / 8  # thickness of the rods, diameters
SHORTEST_OCCLUDED_PATH = 3  # leaves space for a column
GAP = 6  # times


@dataclass(frozen=True)
class MotionScene(Options):
    """What moves in a scene, and how it is seen. Raises ValueError for a path or cycles out of range."""

    path: float = option("width of each path in diameters of the object", 2.0, above=0, at_most=20)
    cycles: float = option("how often each path is travelled over the clip", 2.0, above=0, at_most=20)
    camera: CameraMotion = option(
        "jump: each image from elsewhere, as in D-NeRF; walk: a slow walk around the scene, as with a phone; still: "
        "six cameras that stand still and see each time together",
        "jump",
    )
    background: Backdrop = option(
        "black, white: transparent images, for training and evaluation on that color (data.background); room: a "
        "textured floor and two walls",
        "black",
    )
    objects: ObjectSet = option(
        "two: two moving objects; enter: the box drops into the scene at t = 0.4; occluded: both circle a column; "
        "twins: equal balls whose paths cross; rods: one of a quarter, one of an eighth of the ball's thickness",
        "two",
    )
    turns: float = option("of both objects about a tilted axis over the clip", 0.0, at_least=0, at_most=60)
    twists: float = option("how often they turn so far to and fro instead", 0.0, at_least=0, at_most=20)
    gaps: int = option(f"blocks of {GAP} training times that have no image", 0, at_least=0, at_most=9)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("path", "cycles", "turns", "twists"):
            object.__setattr__(self, name, float(getattr(self, name)))  # 4 and 4.0 are written alike
        if self.objects == "occluded" and self.path < SHORTEST_OCCLUDED_PATH:
            raise ValueError(
                f"path must be at least {SHORTEST_OCCLUDED_PATH} with objects=occluded, which leaves space for the "
                f"column, got {self.path:g}"
            )


@dataclass(frozen=True)
class MovingObject:
    """A solid with center `centre + cosine cos(2 pi f t) + sine sin(2 pi f t)`, f = `cycles`, world units.

    diameter: of the ball, or of a ball with the volume of the box. drop: height from which it enters. A static object
    has 0 cycles; no masks are written for it. turns: over the clip, about an axis of its own, or to each
    side and back, twists times.
    """

    name: str
    solid: Solid
    diameter: float
    centre: Vector
    cosine: Vector = (0.0, 0.0, 0.0)
    sine: Vector = (0.0, 0.0, 0.0)
    cycles: float = 0.0
    drop: float = 0.0
    turns: float = 0.0
    twists: float = 0.0

    @property
    def moves(self) -> bool:
        return self.cycles > 0

    @property
    def reach(self) -> float:
        """Radius of the bounding sphere around the center."""
        return math.hypot(*self.solid.half) if self.solid.shape == "box" else self.solid.half[0]

    def positions(self, times: ArrayLike) -> Floats:
        """Centers at times (T,): (T, 3) world units."""
        time = np.asarray(times, dtype=np.float64)[:, None]
        phase = 2 * np.pi * self.cycles * time
        path = np.array(self.centre) + np.cos(phase) * self.cosine + np.sin(phase) * self.sine
        start, end = ENTER_TIMES
        left = 1 - np.clip((time - start) / (end - start), 0, 1)
        return path + self.drop * left * left * (3 - 2 * left) * [0, 0, 1]

    def turn(self, time: float) -> Floats:
        """(3, 3) its rotation at a time."""
        if not self.turns:
            return np.eye(3)
        c, s = math.cos(TILT), math.sin(TILT)
        share = math.sin(2 * math.pi * self.twists * time) if self.twists else time
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ turn_about_z(2 * math.pi * self.turns * share)


def moving_objects(scene: MotionScene) -> tuple[MovingObject, ...]:
    """All objects of a scene, the moving ones first."""
    diameter = min(0.55, 2.1 / (scene.path + 1))
    edge = 0.806 * diameter  # of the box that has the ball's volume
    radius = scene.path * diameter / 2  # of the circle, and half the length of the line
    aside = min(max(1.0 - radius - diameter / 2, 0.0), 0.45)  # short paths need not share the middle
    height = 0.6 * diameter  # of the box's path above z = 0, and of the ball's below
    ball = MovingObject(
        "ball",
        Solid("beach ball", (diameter / 2,) * 3, ((0.85, 0.22, 0.18), (0.95, 0.68, 0.15))),
        diameter,
        centre=(-aside, 0, -height),
        cosine=(radius * math.cos(0.6), radius * math.sin(0.6), 0),
        sine=(-radius * math.sin(0.6), radius * math.cos(0.6), 0),
        cycles=scene.cycles,
        turns=scene.turns,
        twists=scene.twists,
    )
    occluded = scene.objects == "occluded"
    box = MovingObject(
        "box",
        Solid("box", (edge / 2,) * 3, ((0.12, 0.42, 0.80), (0.22, 0.72, 0.35))),
        diameter,
        centre=(aside, 0, height),
        cosine=(0, radius, 0),
        sine=(radius, 0, 0) if occluded else (0, 0, 0),
        cycles=scene.cycles,
        drop=ENTER_HEIGHT if scene.objects == "enter" else 0.0,
        turns=scene.turns,
        twists=scene.twists,
    )
    still = MovingObject(
        "still",
        Solid("ringed ball", (0.2,) * 3, ((0.56, 0.26, 0.62), (0.85, 0.55, 0.72))),
        0.4,
        (0.25, -0.2, FLOOR + 0.2),
    )
    if scene.objects == "twins":  # both pass the middle at once, one above the other
        ball = replace(ball, centre=(0, 0, -height), cosine=(radius, 0, 0), sine=(0, 0, 0))
        return ball, replace(ball, name="twin", centre=(0, 0, height), cosine=(0, radius, 0)), still
    if scene.objects == "rods":
        thin, thinner = (
            Solid("box", (0.75 * diameter, width * diameter / 2, width * diameter / 2), box.solid.colors)
            for width in RODS
        )
        return replace(ball, name="thin", solid=thin), replace(box, name="thinner", solid=thinner), still
    if not occluded:
        return ball, box, still
    half = 0.85 * (radius - box.reach) / math.sqrt(2)  # within the circles of both
    top = height + edge / 2
    column = Solid("box", (half, half, (top - FLOOR) / 2), ((0.48, 0.44, 0.30), (0.66, 0.60, 0.44)))
    return ball, box, MovingObject("column", column, 2 * half, (0, 0, (top + FLOOR) / 2))


def trace(scene: MotionScene, camera: Camera, time: float) -> list[Hits]:
    """Hits of all surfaces: first those of `moving_objects`, in that order, then those of the room."""
    rays = pixel_rays(camera)
    eye = camera.position
    surfaces = []
    for one in moving_objects(scene):
        centre = one.positions([time])[0]
        among = _rays_around(camera, centre, one.reach)
        surfaces.append(solid_hits(one.solid, centre, eye, rays, turn=one.turn(time), among=among))
    if scene.background == "room":
        surfaces.append(plane_hits(2, FLOOR, 1, _floor, eye, rays))
        surfaces.append(plane_hits(0, -WALL, 1, _bricks, eye, rays))
        surfaces.append(plane_hits(1, WALL, -1, _panels, eye, rays))
    return surfaces


def _rays_around(camera: Camera, centre: Floats, reach: float) -> Ints:
    """Indices (n,) of all rays that can meet the ball of radius `reach` around `centre`, and of some more."""
    corners = np.array(np.meshgrid([-reach, reach], [-reach, reach], [-reach, reach])).reshape(3, 8)
    R, t = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
    x, y, z = R @ (centre[:, None] + corners) + t[:, None]
    columns, rows = camera.width * SAMPLES, camera.height * SAMPLES
    if z.max() <= 0:
        return np.empty(0, dtype=np.int64)
    if z.min() <= 0:
        return np.arange(rows * columns)
    K = camera.K
    left, right = _bounds((K[0, 0] * x / z + K[0, 2]) * SAMPLES, columns)
    top, bottom = _bounds((K[1, 1] * y / z + K[1, 2]) * SAMPLES, rows)
    return (np.arange(top, bottom)[:, None] * columns + np.arange(left, right)).ravel()


def _bounds(values: Floats, limit: int) -> tuple[int, int]:
    return max(math.floor(values.min()) - 1, 0), min(math.ceil(values.max()) + 1, limit)


def _floor(x: Floats, y: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Tiles in two shades of gray, every third one warmer."""
    inside = (np.abs(x) <= WALL) & (np.abs(y) <= WALL)
    column, row = np.floor(x[inside] / 0.29), np.floor(y[inside] / 0.29)
    light = (column + row) % 2 == 0
    albedo = np.where(light, np.array([[0.62], [0.60], [0.56]]), np.array([[0.40], [0.40], [0.42]]))
    warm = (column + 2 * row) % 3 == 0
    return inside, np.where(warm, albedo * [[1.1], [0.95], [0.8]], albedo)


def _bricks(y: Floats, z: Floats) -> tuple[NDArray[np.bool_], Floats]:
    inside = (np.abs(y) <= WALL) & (z >= FLOOR) & (z <= WALL)
    row = np.floor(z[inside] / 0.2)
    along = y[inside] / 0.4 + 0.5 * (row % 2)
    joint = (z[inside] / 0.2 - row < 0.15) | (along - np.floor(along) < 0.08)
    shade = 0.9 + 0.1 * ((np.floor(along) + 3 * row) % 3)
    brick = np.array([[0.56], [0.46], [0.42]]) * shade
    return inside, np.where(joint, np.array([[0.72], [0.70], [0.66]]), brick)


def _panels(x: Floats, z: Floats) -> tuple[NDArray[np.bool_], Floats]:
    inside = (np.abs(x) <= WALL) & (z >= FLOOR) & (z <= WALL)
    stripe = np.floor(x[inside] / 0.22) % 3
    low = z[inside] < -0.35
    tone = np.where(low, 0.36 + 0.06 * stripe, 0.58 + 0.06 * stripe)
    return inside, tone * np.array([[1.0], [1.02], [0.94]])


def fov_x(scene: MotionScene) -> float:
    """Horizontal field of view of all cameras of a scene, radians."""
    return ROOM_FOV_X if scene.background == "room" else FOV_X


def scene_cameras(scene: MotionScene, split: str, times: ArrayLike, seed: int, *, size: int) -> list[Camera]:
    """Cameras of the images of a split, at `times` (T,). seed: of the jumps.

    For training images of static cameras, T is a multiple of STILL_CAMERAS, and the cameras 0 to 5 alternate.
    """
    time = np.asarray(times, dtype=np.float64)
    room = scene.background == "room"
    places: Sequence[tuple[float, float]]
    if scene.camera == "jump":
        low, high = ROOM_HEIGHT if room else ENTER_JUMP_HEIGHT if scene.objects == "enter" else JUMP_HEIGHT
        start, width = (ROOM_CENTRE - ROOM_AZIMUTH / 2, ROOM_AZIMUTH) if room else (0.0, 2 * math.pi)
        spread = jumps(len(time), 3 * seed + ("train", "val", "test").index(split))
        places = [(start + width * turn, low + (high - low) * lift) for turn, lift in spread]
    elif scene.camera == "walk":
        width = ROOM_AZIMUTH if room else WALK_AZIMUTH
        off = {"train": 0.0, "val": -0.04, "test": 0.04}[split]  # beside the walk, by turns on either side
        sides = off * (-1.0) ** np.arange(len(time))
        places = [
            (ROOM_CENTRE + width * (t - 0.5) + side, WALK_HEIGHT + WALK_BOB * math.sin(4 * math.pi * t) + side)
            for t, side in zip(time, sides, strict=True)
        ]
    else:
        width = ROOM_AZIMUTH if room else 2 * math.pi * (1 - 1 / STILL_CAMERAS)
        heights = (0.40, 0.55)
        if split == "train":
            places = [
                (ROOM_CENTRE + width * (i / (STILL_CAMERAS - 1) - 0.5), heights[i % 2])
                for i in np.arange(len(time)) % STILL_CAMERAS
            ]
        else:  # one more camera for each split, between two of training
            between = 0.5 if split == "test" else 1.5
            places = [(ROOM_CENTRE + width * (between / (STILL_CAMERAS - 1)), sum(heights) / 2)] * len(time)
    return [camera_at(azimuth, height, size=size, fov_x=fov_x(scene)) for azimuth, height in places]
