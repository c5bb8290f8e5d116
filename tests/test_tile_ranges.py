"""Where each tile's list begins and ends."""

import numpy as np
import pytest
import torch
from helpers.scenes import oblique_camera, random_scene
from helpers.stages import all_of, capture

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.rasterize import rasterize, rasterizer_of

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize(
    ("count", "size"), [(1, 0.01), (2, 0.01), (3, 0.02), (5, 0.05), (40, 0.02), (41, 0.02), (700, 0.05), (30, 3.0)]
)
def test_ranges_are_where_the_sorted_keys_change(
    monkeypatch: pytest.MonkeyPatch, device: Device, count: int, size: float
) -> None:
    scene, camera = random_scene(count, count, size=size), oblique_camera(101, 61)
    scene["opacities"][:] = 0.9
    copies = capture(monkeypatch, "tile_ranges", "tile_keys", "ranges", "needed")
    drawn = rasterize(**scene, camera=camera, device=device)
    rasterizer = rasterizer_of(device)
    needed = int(all_of(copies[-1]["needed"])[0])
    assert (needed > 0) == bool((drawn.radii > 0).any())
    keys = all_of(copies[-1]["tile_keys"])[:needed]
    assert (np.diff(keys.astype(np.int64)) >= 0).all()
    shape = rasterizer.config
    tiles = -(-camera.width // shape.tile_width) * -(-camera.height // shape.tile_height)
    ranges = all_of(copies[-1]["ranges"])[: 4 * tiles].reshape(tiles, 4)
    first, last = (np.searchsorted(keys, np.arange(tiles), side) for side in ("left", "right"))
    filled = last > first
    np.testing.assert_array_equal(ranges[filled, 0], first[filled])
    np.testing.assert_array_equal(ranges[filled, 1], last[filled])
    np.testing.assert_array_equal(ranges[~filled, :2], 0)


def test_lists_are_left_where_nothing_behind_is_seen(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """The drawn part of each list ends early behind opaque splats, and only there."""
    camera = oblique_camera(101, 61)
    copies = capture(monkeypatch, "rasterize", "ranges")
    for opacity in (1.0, 0.01):
        scene = random_scene(3000, 1, size=0.3)
        scene["opacities"][:] = opacity
        rasterize(**scene, camera=camera, device=device)
        first, last, drawn, _ = all_of(copies[-1]["ranges"]).reshape(-1, 4).T
        filled = last > first
        assert filled.any()
        assert (drawn[filled] > first[filled]).all()
        assert (drawn[filled] <= last[filled]).all()
        left = (drawn < last)[filled]
        assert left.mean() > 0.5 if opacity == 1.0 else not left.any()


def test_lists_of_the_image_before_are_gone(device: Device) -> None:
    """An image with splats everywhere, then one without any, then with few."""
    camera = oblique_camera(101, 61)
    everywhere, few = random_scene(50, 1, size=3.0), random_scene(3, 2)
    expected = rasterize(**few, camera=camera, device=device).image
    rasterize(**everywhere, camera=camera, device=device)
    nothing = rasterize(**(few | {"opacities": torch.zeros(3)}), camera=camera, device=device)
    assert not nothing.image.any()
    assert not nothing.alpha.any()
    assert torch.equal(rasterize(**few, camera=camera, device=device).image, expected)
