"""Which tiles each splat is listed in: every one with a pixel that it reaches, hardly any other, and all counted."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from helpers.reference import ALPHA_MIN
from helpers.scenes import Scene, front_camera, needles, oblique_camera, random_scene
from helpers.stages import all_of, capture
from numpy.typing import NDArray

from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterize, rasterizer_of

pytestmark = pytest.mark.kernels


class Emitted(NamedTuple):
    """Slots in order. splats: (N, 12) of common/splat.wgsl; counts: (N,) tiles that the projection counted."""

    tile: NDArray[Any]
    splat: NDArray[Any]
    ids: NDArray[Any]  # of the visible splats, in depth order
    offsets: NDArray[Any]  # of their first slots
    counts: NDArray[Any]
    splats: NDArray[Any]
    tiles: tuple[int, int]  # columns, rows
    tile_size: tuple[int, int]  # pixels

    @property
    def touched(self) -> NDArray[np.bool_]:
        """(N, rows, columns) whether the splat is listed in the tile."""
        columns, rows = self.tiles
        listed = np.zeros((len(self.counts), rows * columns + 1), bool)
        listed[self.splat, self.tile] = True
        return listed[:, :-1].reshape(-1, rows, columns)  # without pads


def duplicated(monkeypatch: pytest.MonkeyPatch, device: Device, scene: Scene, camera: Camera) -> Emitted:
    names = ("tile_keys", "slot_ids", "ids", "offsets", "tile_counts", "splats")
    copies = capture(monkeypatch, "duplicate_with_keys", *names)
    rasterize(**scene, camera=camera, device=device)
    count, copy = len(scene["means"]), copies[-1]  # the last draw is one whose lists fitted
    tile_keys, slot_ids, ids, offsets, counts = (all_of(copy[name]) for name in names[:5])
    counts = counts[:count].astype(np.int64)
    seen, total = int((counts > 0).sum()), int(counts.sum())
    shape = rasterizer_of(device).config
    size = shape.tile_width, shape.tile_height
    return Emitted(
        tile_keys[:total].astype(np.int64),
        slot_ids[:total].astype(np.int64),
        ids[:seen],
        offsets[:seen],
        counts,
        copy["splats"].read(),
        (-(-camera.width // size[0]), -(-camera.height // size[1])),
        size,
    )


def log_alphas(splats: NDArray[Any], camera: Camera, dtype: type) -> NDArray[Any]:
    """(N, height, width) log2 of opacity exp(-q) at each pixel's centre, before the cuts."""
    x = np.arange(camera.width, dtype=dtype) + dtype(0.5)
    y = np.arange(camera.height, dtype=dtype) + dtype(0.5)
    s = splats.astype(dtype)[:, :, None, None]
    dx, dy = x[None, None, :] - s[:, 0], y[None, :, None] - s[:, 1]
    half = dtype(0.5 * np.log2(np.e))
    return s[:, 5] - half * (s[:, 2] * dx * dx + s[:, 4] * dy * dy) - 2 * half * s[:, 3] * dx * dy


def by_tile(pixels: NDArray[np.bool_], emitted: Emitted) -> NDArray[np.bool_]:
    """(N, rows, columns): whether any pixel of the tile is set."""
    (columns, rows), (width, height) = emitted.tiles, emitted.tile_size
    padded = np.zeros((len(pixels), rows * height, columns * width), bool)
    padded[:, : pixels.shape[1], : pixels.shape[2]] = pixels
    return padded.reshape(len(pixels), rows, height, columns, width).any(axis=(2, 4))


def thresholds() -> Scene:
    """Splats so faint that their ellipses are smaller than a pixel, everywhere between pixel centres."""
    count = 300
    generator = torch.Generator().manual_seed(5)
    scene = random_scene(count, 5, size=1e-3)
    scene["opacities"] = ALPHA_MIN * (1 + torch.rand(count, generator=generator) ** 2)
    return scene


SCENES = {
    "small": (random_scene(400, 1, size=0.03), oblique_camera(101, 61)),
    "large": (random_scene(150, 2, size=0.4), oblique_camera(101, 61)),
    "needles": (needles(80, 3, front_camera(320, 200)), front_camera(320, 200)),
    "long needles": (needles(60, 4, front_camera(320, 200), length=3000.0), front_camera(320, 200)),
    "faint": (thresholds(), oblique_camera(101, 61)),
    "one pixel": (random_scene(100, 6, size=0.5), oblique_camera(1, 1)),
    "one row": (random_scene(100, 7, size=0.2), oblique_camera(130, 3)),
}
all_scenes = pytest.mark.parametrize("name", SCENES)


@all_scenes
def test_the_lists_of_tiles(monkeypatch: pytest.MonkeyPatch, device: Device, name: str) -> None:
    scene, camera = SCENES[name]
    emitted = duplicated(monkeypatch, device, scene, camera)
    check_none_missed(emitted, camera)
    check_few_in_vain(emitted)
    check_counts(emitted)


def check_none_missed(emitted: Emitted, camera: Camera) -> None:
    """Each tile with a pixel that a splat reaches is in its list."""
    seen = emitted.splats[:, 10] > 0
    assert seen.sum() > 20
    for dtype in (np.float64, np.float32):  # exactly, and about as the rasterizer rounds
        reached = log_alphas(emitted.splats, camera, dtype) >= np.log2(ALPHA_MIN)
        missed = by_tile(reached & seen[:, None, None], emitted) & ~emitted.touched
        assert not missed.any(), f"splats {np.unique(missed.nonzero()[0])} miss tiles in {dtype.__name__}"


def check_few_in_vain(emitted: Emitted) -> None:
    """The ellipse meets the rectangle of the pixel centres of each tile, a little larger than the padding makes it."""
    vain = emitted.touched & (least_distance(emitted, grown=0.03) > 2 * np.log(2) * log_reach(emitted)[:, None, None])
    assert not vain.any(), f"splats {np.unique(vain.nonzero()[0])} are listed in tiles that they do not reach"


def log_reach(emitted: Emitted) -> NDArray[Any]:
    """(N,) log2 of opacity over ALPHA_MIN."""
    return emitted.splats[:, 5].astype(np.float64) - np.log2(ALPHA_MIN)


def least_distance(emitted: Emitted, grown: float) -> NDArray[Any]:
    """(N, rows, columns) the least a x^2 + 2 b x y + c y^2 over the rectangle of the tile's pixel centres."""
    (columns, rows), (width, height) = emitted.tiles, emitted.tile_size
    s = emitted.splats.astype(np.float64)[:, :, None, None]
    a, b, c = s[:, 2], s[:, 3], s[:, 4]
    left = np.arange(columns)[None, None, :] * width + 0.5 - grown - s[:, 0]
    top = np.arange(rows)[None, :, None] * height + 0.5 - grown - s[:, 1]
    right, bottom = left + width - 1 + 2 * grown, top + height - 1 + 2 * grown
    inside = (left <= 0) & (right >= 0) & (top <= 0) & (bottom >= 0)
    least = np.where(inside, 0.0, np.inf)
    # Elsewhere it lies on an edge: along each the form is a parabola, lowest at its vertex or at the edge's nearer end.
    for x in (left, right):
        y = np.clip(-b / np.where(c > 0, c, 1) * x, top, bottom)
        least = np.minimum(least, a * x * x + 2 * b * x * y + c * y * y)
    for y in (top, bottom):
        x = np.clip(-b / np.where(a > 0, a, 1) * y, left, right)
        least = np.minimum(least, a * x * x + 2 * b * x * y + c * y * y)
    return least


def check_counts(emitted: Emitted) -> None:
    """No tile twice, and few pads, at the end; each splat's slots side by side, splats from front to back."""
    columns, rows = emitted.tiles
    pads = emitted.tile == rows * columns
    assert emitted.tile.max(initial=0) <= rows * columns
    assert pads.mean() < 0.02
    assert (pads[1:] | ~pads[:-1] | (np.diff(emitted.splat) != 0)).all(), "a tile behind a pad"
    assert np.array_equal(np.bincount(emitted.splat, minlength=len(emitted.counts)), emitted.counts)
    written = emitted.splat[~pads] * rows * columns + emitted.tile[~pads]
    assert len(np.unique(written)) == len(written)
    assert np.array_equal(emitted.splat, np.repeat(emitted.ids, emitted.counts[emitted.ids]))
    assert np.array_equal(emitted.offsets, np.cumsum(emitted.counts[emitted.ids]) - emitted.counts[emitted.ids])
    depths = emitted.splats[emitted.ids, 9]
    assert (np.diff(depths) >= 0).all()


def altered(monkeypatch: pytest.MonkeyPatch, device: Device, *changes: tuple[str, str, str]) -> None:
    """Compile shaders anew, each with a text in a file replaced by another."""
    text = shader.shader_text

    def changed(name: str) -> str:
        source = text(name)
        for file, found, replacement in changes:
            if file == name:
                assert found in source
                source = source.replace(found, replacement)
        return source

    monkeypatch.setattr(device, "kernel_cache", {})
    monkeypatch.setattr(shader, "shader_text", changed)


def counted_within(padding: str) -> tuple[str, str, str]:
    return "common/tile", "COUNTED_PADDING: f32 = 0.025", f"COUNTED_PADDING: f32 = {padding}"


@pytest.mark.nightly
@all_scenes
def test_a_driver_that_rounds_otherwise_loses_no_tile(
    monkeypatch: pytest.MonkeyPatch, device: Device, name: str
) -> None:
    """There are slots for tiles that the pass that writes finds and an exact count would not have found."""
    scene, camera = SCENES[name]
    moved = "duplicate_with_keys", "make_ellipse(a.xy,", "make_ellipse(a.xy + 0.004,"
    touched = []
    for change in ([moved], [moved, counted_within("1.0")]):
        with monkeypatch.context() as patch:
            altered(patch, device, *change)
            touched.append(duplicated(patch, device, scene, camera).touched)
    assert np.array_equal(*touched)


def test_equal_depths_go_by_index(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    scene, camera = random_scene(500, 8), front_camera(101, 61)
    scene["means"][:, 2] = 2.0 + 0.5 * (torch.arange(500) % 3)
    emitted = duplicated(monkeypatch, device, scene, camera)
    expected = sorted(emitted.ids.tolist(), key=lambda i: (i % 3, i))
    assert emitted.ids.tolist() == expected
