"""Films with known cameras: a textured room in which a textured board moves, and files as phones write them."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from raytrace import SAMPLES, Floats, combine, pixel_means, pixel_rays, plane_hits, to_bytes

from lapgs_wgpu.splat.camera import Camera

ROOM = 2.0  # distance of the walls; half side of the floor, which reaches twice as far to the right


class Texture:
    """Noise of several scales, which has features everywhere."""

    def __init__(self, seed: int) -> None:
        self.tables = np.random.default_rng(seed).uniform(0.1, 0.9, (4, 64, 64, 3))

    def __call__(self, x: Floats, y: Floats) -> Floats:
        """Colors (3, n) at places (n,)."""
        color = np.zeros((3, len(x)))
        for table, scale, weight in zip(self.tables, (2.3, 5.1, 11.7, 19.0), (0.35, 0.35, 0.2, 0.1), strict=True):
            i, j = np.floor(x * scale).astype(int) % 64, np.floor(y * scale).astype(int) % 64
            color += weight * table[i, j].T
        return color


FLOOR, LEFT, BACK, BOARD = (Texture(seed) for seed in range(4))


class Board:
    """A board that faces the cameras and wanders: `half` its half width and height; `reach` how far it wanders to
    either side; `cycles` how often over the film. None of it with half = 0."""

    def __init__(self, half: float = 0.0, reach: float = 0.6, cycles: float = 1.5) -> None:
        self.half, self.reach, self.cycles = half, reach, cycles

    def place(self, t: float) -> tuple[float, float, float]:
        """Its middle at time t in [0, 1]."""
        turn = 2 * np.pi * self.cycles * t
        return self.reach * np.sin(turn), -0.3 + 0.3 * np.sin(0.7 * turn), 0.1 + 0.25 * self.reach * np.cos(1.3 * turn)


def walk(count: int, width: int, height: int) -> list[Camera]:
    """A camera that walks past the room, z up, looking near its middle."""
    turns = np.linspace(-0.5, 0.5, count)
    return [
        Camera.looking_at(
            [4.2 * np.sin(turn), -4.2 * np.cos(turn), 0.7 + 0.25 * np.sin(5 * turn)],
            [0.1 * np.sin(9 * turn), 0.0, 0.1],
            up=[0, 0, 1],
            fov_x=0.9,
            width=width,
            height=height,
        )
        for turn in turns
    ]


def drawn(camera: Camera, t: float, board: Board) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The image (H, W, 3) at time t, and the pixels (H, W) that show the board."""
    rays, eye = pixel_rays(camera), camera.position
    x0, y0, z0 = board.place(t)

    def of_room(texture: Texture, low: float, high: float, far: float = ROOM):
        def albedo(a: Floats, b: Floats):
            inside = (a >= -ROOM) & (a <= far) & (b >= low) & (b <= high)
            return inside, texture(a[inside], b[inside])

        return albedo

    def of_board(a: Floats, b: Floats):
        inside = (np.abs(a - x0) <= board.half) & (np.abs(b - z0) <= board.half)
        return inside, BOARD(a[inside] - x0 + 3, b[inside] - z0 + 3)

    surfaces = [
        plane_hits(1, y0, -1, of_board, eye, rays),
        plane_hits(2, -1.0, 1, of_room(FLOOR, -ROOM, ROOM, 2 * ROOM), eye, rays),
        plane_hits(0, -ROOM, 1, of_room(LEFT, -1.0, 2.2), eye, rays),
        plane_hits(1, ROOM, -1, of_room(BACK, -1.0, 2.2, 2 * ROOM), eye, rays),
    ]
    color, owner = combine(surfaces, camera.width * camera.height * SAMPLES**2)
    image = to_bytes(np.moveaxis(pixel_means(color, camera), 0, 2))
    return image, pixel_means(owner == 0, camera) > 0.5


def room_cloud(count: int, noise: float, seed: int = 0) -> tuple[Floats, Floats]:
    """Points (3 count, 3) of floor and walls, off by `noise` (standard deviation along each axis), and their colors."""
    rng = np.random.default_rng(seed)

    def drawn_from(low: float, high: float) -> Floats:
        return rng.uniform(low, high, count)

    floor = drawn_from(-ROOM, 2 * ROOM), drawn_from(-ROOM, ROOM), np.full(count, -1.0)
    left = np.full(count, -ROOM), drawn_from(-ROOM, ROOM), drawn_from(-1.0, 2.2)
    back = drawn_from(-ROOM, 2 * ROOM), np.full(count, ROOM), drawn_from(-1.0, 2.2)
    colors = [FLOOR(floor[0], floor[1]), LEFT(left[1], left[2]), BACK(back[0], back[2])]
    points = np.concatenate([np.stack(surface, axis=1) for surface in (floor, left, back)])
    return points + rng.normal(scale=noise, size=points.shape), np.concatenate(colors, axis=1).T


def noise_pictures(count: int, width: int = 64, height: int = 48) -> list[NDArray[np.uint8]]:
    """Pictures (H, W, 3) of squares of random colors, each another one."""
    rng = np.random.default_rng(0)
    squares = rng.integers(40, 216, (count, height // 8, width // 8, 3), dtype=np.uint8)
    return list(squares.repeat(8, axis=1).repeat(8, axis=2))


def write_film(
    path: Path,
    pictures: Sequence[NDArray[np.uint8]],
    *,
    times: Sequence[float] | None = None,
    rate: int = 30,
    options: dict[str, str] | None = None,
    pix_fmt: str = "yuv420p",
    aspect: str = "1",
) -> Path:
    """H.264. times: seconds of each frame, for films of variable rate. aspect: width by height of a pixel."""
    av = __import__("av")
    from fractions import Fraction

    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=rate, options={"crf": "12", "bf": "0"} | (options or {}))
        stream.width, stream.height, stream.pix_fmt = pictures[0].shape[1], pictures[0].shape[0], pix_fmt
        base = Fraction(1, 1000) if times else Fraction(1, rate)
        stream.codec_context.time_base = base
        stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        for i, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts = round(1000 * times[i]) if times else i
            frame.time_base = base
            for packet in stream.encode(frame):
                file.mux(packet)
        for packet in stream.encode():
            file.mux(packet)
    return path


def turn_film(path: Path, degrees: int) -> None:
    """Write a rotation into the header of an mp4, as phones held upright do: 90, 180 or 270, clockwise."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 20 + 16  # version and flags; times, number, length; layer, volume
    c, s = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    matrix = [c << 16, s << 16, 0, -s << 16, c << 16, 0, 0, 0, 1 << 30]
    data[at : at + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(data)


def pose_errors(found: dict[str, NDArray[np.float64]], true: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Distances of camera centers from the true ones after the best similarity, relative to the largest distance of a
    true center from their mean. Umeyama 1991."""
    names = sorted(found)
    a, b = (np.stack([centers[name] for name in names]) for centers in (found, true))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = np.trace(np.diag(S) @ D) / np.square(a).sum()
    errors = np.linalg.norm(b - scale * a @ (U @ D @ Vt).T, axis=1)
    return errors / np.linalg.norm(b, axis=1).max()
