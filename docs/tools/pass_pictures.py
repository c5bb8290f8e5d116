"""The pictures of docs/how-it-works.md: what the passes and discovery leave, of a run of the built-in scene."""

import colorsys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lapgs_wgpu import Camera, Gaussians, Scene4D, load_config
from lapgs_wgpu.discovery.discover import tracks_in_images
from lapgs_wgpu.discovery.static_fit import static_fit
from lapgs_wgpu.discovery.surface_points import surface_points
from lapgs_wgpu.discovery.tracks import find_tracks
from lapgs_wgpu.gpu.array import read_all
from lapgs_wgpu.gpu.device import open_device
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.constants import COLOR, MEAN, OPACITY, RADIUS
from lapgs_wgpu.splat.drawing import Drawing
from lapgs_wgpu.splat.rasterize import rasterizer_of, upload_gaussians
from lapgs_wgpu.train.setup import open_data, resolve_for_dataset

Picture = NDArray[np.uint8]
Floats = NDArray[np.float32]

SIZE = 304  # pixels of a panel's side; whole tiles of 8 and of 16
GAP = 4  # white pixels between panels
FINE = 3  # lines are drawn this many times larger and shrunk
TIME = 0.3
CONIC = slice(2, 5)  # columns of a splat: a, b, c of a x^2 + 2 b x y + c y^2 (shaders/common/splat.wgsl)
EVERY = 4  # of the splats, whose outline is drawn
SHARES = (0.1, 0.3, 0.6, 1.0)  # of the visible Gaussians, from the nearest one on
PATHS, TIMES = 260, 33  # moving Gaussians whose way is drawn, and points of it


class Passes(NamedTuple):
    """What the passes of one image left on the device, read back."""

    image: Floats  # (4, H, W) red, green, blue, transmittance
    splats: Floats  # (N, SPLAT_FLOATS)
    order: NDArray[np.uint32]  # (visible,) Gaussians by depth
    ranges: NDArray[np.uint32]  # (tiles, 4) first, end and drawn end of each tile's list
    tiles: tuple[int, int]  # rows and columns


def passes_of(gaussians: Gaussians[torch.Tensor], camera: Camera) -> Passes:
    """Draw an image and read back what each pass left."""
    rasterizer = rasterizer_of(open_device())
    arrays = upload_gaussians(rasterizer.pool, gaussians)
    drawing: Drawing = rasterizer.draw(arrays, camera)
    while rasterizer.grow_on_overflow(drawing):
        drawing = rasterizer.draw(arrays, camera)
    names = ("image", "splats", "ids", "visible", "ranges")
    image, splats, order, visible, ranges = read_all([drawing.arrays[name] for name in names])
    config = rasterizer.config
    tiles = camera.height // config.tile_height, camera.width // config.tile_width
    return Passes(image, splats, order[: int(visible[0])], ranges[:-1], tiles)


def eight_bit(values: NDArray[np.floating]) -> Picture:
    """(H, W, 3) or (H, W) in [0, 1] as a picture."""
    picture = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)


def side_by_side(panels: Sequence[Picture]) -> Picture:
    gap = np.full((panels[0].shape[0], GAP, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:], axis=1)


def stacked(rows: Sequence[Picture]) -> Picture:
    gap = np.full((GAP, rows[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for row in rows for part in (gap, row)][1:], axis=0)


class Lines:
    """A picture on which lines are drawn, smoothly."""

    def __init__(self, below: Picture) -> None:
        self.size = below.shape[1], below.shape[0]
        self._image = Image.fromarray(below).resize(
            (FINE * self.size[0], FINE * self.size[1]), Image.Resampling.BICUBIC
        )
        self._draw = ImageDraw.Draw(self._image)

    def line(self, points: NDArray[np.floating], color: tuple[int, int, int], width: int = FINE) -> None:
        """points: (n, 2) pixels."""
        self._draw.line([(float(x), float(y)) for x, y in FINE * points], fill=color, width=width, joint="curve")

    def dot(self, point: NDArray[np.floating], color: tuple[int, int, int], radius: float = 1.0) -> None:
        x, y = (FINE * point).tolist()
        r = FINE * radius
        self._draw.ellipse((x - r, y - r, x + r, y + r), fill=color)

    def picture(self) -> Picture:
        return np.asarray(self._image.resize(self.size, Image.Resampling.BOX))


def bytes_of(color: Sequence[float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * min(max(float(value), 0.0), 1.0)) for value in color)
    return red, green, blue


def hue(share: float) -> tuple[int, int, int]:
    """From red at 0 to violet at 1."""
    return bytes_of(colorsys.hsv_to_rgb(0.8 * share, 0.9, 1.0))


def heat(values: NDArray[np.floating]) -> Picture:
    """(H, W) in [0, 1]: black, violet, orange, white."""
    stops = np.array([[0, 0, 0], [0.35, 0.1, 0.5], [0.95, 0.45, 0.15], [1, 1, 0.85]])
    positions = np.linspace(0, 1, len(stops))
    return eight_bit(np.stack([np.interp(values, positions, stops[:, i]) for i in range(3)], axis=-1))


def projected(scene: Scene4D, camera: Camera) -> Picture:
    """Means, outlines at one standard deviation, and the image."""
    passes = passes_of(scene.at(TIME), camera)
    nearest_last = passes.splats[passes.order[::-1]]
    means, outlines = (Lines(np.zeros((camera.height, camera.width, 3), np.uint8)) for _ in range(2))
    turn = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for number, splat in enumerate(nearest_last):
        color = bytes_of(splat[COLOR])
        means.dot(splat[MEAN], color, 0.7)
        if number % EVERY == 0 and splat[OPACITY] > -2 and splat[RADIUS] < SIZE / 4:
            a, b, c = splat[CONIC].astype(np.float64)
            values, axes = np.linalg.eigh([[a, b], [b, c]])
            outlines.line(splat[MEAN] + (axes @ (circle / np.sqrt(values)[:, None])).T, color, FINE // 2)
    return side_by_side([means.picture(), outlines.picture(), eight_bit(passes.image[:3].transpose(1, 2, 0))])


def tiles(scene: Scene4D, camera: Camera) -> Picture:
    """The tiles, the length of their lists, and how much of these is drawn before no pixel sees further."""
    passes = passes_of(scene.at(TIME), camera)
    rows, columns = passes.tiles
    image = Lines(eight_bit(0.8 * passes.image[:3].transpose(1, 2, 0)))
    for edge in np.linspace(0, camera.width, columns + 1):
        image.line(np.array([[edge, 0], [edge, camera.height]]), (110, 110, 110), 1)
    for edge in np.linspace(0, camera.height, rows + 1):
        image.line(np.array([[0, edge], [camera.width, edge]]), (110, 110, 110), 1)
    first, end, drawn = (passes.ranges[:, i].astype(np.int64) for i in range(3))
    size = np.ones((camera.height // rows, camera.width // columns))
    most = (end - first).max()
    panels = [heat(np.kron((until - first).reshape(rows, columns) / most, size)) for until in (end, drawn)]
    return side_by_side([image.picture(), *panels])


def blending(scene: Scene4D, camera: Camera) -> Picture:
    """The image, and below it the transmittance, of ever more of the Gaussians, front to back."""
    gaussians = scene.at(TIME)
    order = torch.from_numpy(passes_of(gaussians, camera).order.astype(np.int64))
    colors, transmittances = [], []
    for share in SHARES:
        near = order[: round(share * len(order))]
        part = replace(gaussians, **{name: of_all[near] for name, of_all in gaussians.arrays().items()})
        image = passes_of(part, camera).image
        colors.append(eight_bit(image[:3].transpose(1, 2, 0)))
        transmittances.append(eight_bit(image[3]))
    return stacked([side_by_side(colors), side_by_side(transmittances)])


def project(points: NDArray[np.floating], camera: Camera) -> NDArray[np.float64]:
    """(..., 2) pixels of points (..., 3), world units."""
    seen = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    return seen[..., :2] / seen[..., 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]


def motion(scene: Scene4D, camera: Camera) -> Picture:
    """Three times, and the ways of Gaussians over the clip, whose hue is the time."""
    times = np.linspace(0, 1, TIMES)
    images = [eight_bit(passes_of(scene.at(t), camera).image[:3].transpose(1, 2, 0)) for t in (0.0, 0.5)]
    paths = np.stack([scene.at(float(t)).means.numpy(force=True) for t in times])
    opaque = scene.canonical().opacities.numpy(force=True) > 0.5
    length = np.linalg.norm(np.diff(paths, axis=0), axis=2).sum(axis=0) * opaque
    moving = np.flatnonzero(length > 0.25 * length.max())
    chosen = np.random.default_rng(0).permutation(moving)[:PATHS]
    ways = Lines(eight_bit(0.35 * images[0] / 255))
    pixels = project(paths[:, chosen], camera)
    for way in pixels.transpose(1, 0, 2):
        for i in range(TIMES - 1):
            ways.line(way[i : i + 2], hue(times[i]), FINE // 2)
    return side_by_side([*images, ways.picture()])


def discovery(scenes: Path) -> Picture:
    """A training image, the static fit, the moving pixels, and the tracks over the static fit, a hue for each part.

    scenes: folder of built-in scenes.
    """
    given, dataset = open_data(load_config("demo", {"data.path": "synthetic"}), scenes)
    config, device = resolve_for_dataset(given, dataset), open_device()
    meter = Progress(config.discovery.steps, "steps of the static fit", None)
    fit = static_fit(config, dataset, device, meter.at)
    static, images = fit.scene, fit.images
    meter.clear()
    clouds = surface_points(images, config.points.box)
    found = find_tracks(clouds)
    tracks = None if found is None else tracks_in_images(found, clouds.times, images, static, 0.0, together=False)
    if tracks is None:
        raise SystemExit("discovery has found no moving parts in the built-in scene")
    shown = min(images, key=lambda image: abs(image.time - TIME))
    camera = shown.camera.resized(SIZE, SIZE)
    still = eight_bit(static.render(camera, 0.0, depth=False).image.numpy(force=True))

    def enlarged(picture: Picture) -> Picture:
        return np.asarray(Image.fromarray(picture).resize((SIZE, SIZE), Image.Resampling.NEAREST))

    ways = Lines(eight_bit(0.45 * still / 255))
    parts = tracks.part.max() + 1
    chosen = np.random.default_rng(0).permutation(len(tracks.part))[:PATHS]
    pixels = project(tracks.paths[:, chosen], camera)
    for way, part in zip(pixels.transpose(1, 0, 2), tracks.part[chosen], strict=True):
        ways.line(way, hue(part / max(parts, 1)), FINE // 2)
    moving = shown.image * shown.mask[..., None]
    return side_by_side([enlarged(eight_bit(shown.image)), still, enlarged(eight_bit(moving)), ways.picture()])
