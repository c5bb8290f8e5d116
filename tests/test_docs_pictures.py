"""The pictures of docs/how-it-works.md that show what the passes leave (docs/tools/pass_pictures.py)."""

import itertools
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.trained_scenes import OURS, trained
from numpy.typing import NDArray

from lapgs_wgpu import Camera
from lapgs_wgpu.gpu.device import Device

passes = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "docs/tools/pass_pictures.py")))


def panels(picture: NDArray[np.uint8], count: int) -> list[NDArray[np.int64]]:
    """The squares of a row, which has no other pixels than them and the gaps between."""
    side, gap = passes.SIZE, passes.GAP
    assert picture.shape == (side, count * side + (count - 1) * gap, 3)
    return [picture[:, i * (side + gap) :][:, :side].astype(np.int64) for i in range(count)]


@pytest.mark.parametrize("antialiased", [True, False])
def test_each_shows_what_is_rendered(device: Device, antialiased: bool) -> None:
    scene, side = trained(device, OURS, 300), passes.SIZE
    scene.antialiased = antialiased
    camera = Camera.looking_at([0, -4, 0.5], [0, 0, 0], up=[0, 0, 1], fov_x=0.8, width=side, height=side)
    rendered = np.asarray(passes.eight_bit(scene.render(camera, passes.TIME).image.numpy()))
    assert np.array_equal(panels(passes.projected(scene, camera), 3)[-1], rendered)

    blended = passes.blending(scene, camera)
    assert len(blended) == 2 * side + passes.GAP
    assert np.array_equal(panels(blended[:side], 4)[-1], rendered), "all Gaussians are the image"
    light = panels(blended[-side:], 4)
    assert all((nearer >= farther).all() for nearer, farther in itertools.pairwise(light))

    moved = panels(passes.motion(scene, camera), 3)
    assert np.array_equal(moved[0], passes.eight_bit(scene.render(camera, 0.0).image.numpy()))

    _, listed, drawn = (panel.sum(axis=2) for panel in panels(passes.tiles(scene, camera), 3))
    assert (drawn <= listed).all(), "brighter is longer"
    empty = rendered.sum(axis=2) == 0
    assert listed[empty].mean() < listed[~empty].mean()
