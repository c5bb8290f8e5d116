"""The pictures of docs/how-it-works.md that show what the passes leave (docs/tools/passes.py)."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers.trained_scenes import OURS, trained
from numpy.typing import NDArray

from lapgs_wgpu import Camera, Scene4D
from lapgs_wgpu.gpu.device import Device


@pytest.fixture(scope="module")
def passes() -> ModuleType:
    file = Path(__file__).parents[1] / "docs" / "tools" / "passes.py"
    spec = importlib.util.spec_from_file_location("passes", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", params=[True, False], ids=["antialiased", "plain"])
def scene(request: pytest.FixtureRequest, device: Device) -> Scene4D:
    scene = trained(device, OURS, 300)
    scene.antialiased = request.param
    return scene


@pytest.fixture(scope="module")
def camera(passes: ModuleType) -> Camera:
    return Camera.looking_at([0, -4, 0.5], [0, 0, 0], up=[0, 0, 1], fov_x=0.8, width=passes.SIZE, height=passes.SIZE)


@pytest.fixture(scope="module")
def rendered(passes: ModuleType, scene: Scene4D, camera: Camera) -> NDArray[np.uint8]:
    return np.asarray(passes.eight_bit(scene.render(camera, passes.TIME).image.numpy()))


def panels(passes: ModuleType, picture: NDArray[np.uint8], count: int) -> list[NDArray[np.int64]]:
    """The squares of a row, which has no other pixels than them and the gaps between."""
    side, gap = passes.SIZE, passes.GAP
    assert picture.shape == (side, count * side + (count - 1) * gap, 3)
    return [picture[:, i * (side + gap) :][:, :side].astype(np.int64) for i in range(count)]


def test_each_shows_what_is_rendered(
    passes: ModuleType, scene: Scene4D, camera: Camera, rendered: NDArray[np.uint8]
) -> None:
    assert np.array_equal(panels(passes, passes.projected(scene, camera), 3)[-1], rendered)

    side, blended = passes.SIZE, passes.blending(scene, camera)
    assert len(blended) == 2 * side + passes.GAP
    assert np.array_equal(panels(passes, blended[:side], 4)[-1], rendered), "all Gaussians are the image"
    light = panels(passes, blended[-side:], 4)
    assert all((nearer >= farther).all() for nearer, farther in itertools.pairwise(light))

    moved = panels(passes, passes.motion(scene, camera), 3)
    assert np.array_equal(moved[0], passes.eight_bit(scene.render(camera, 0.0).image.numpy()))


def test_tiles_are_the_brighter_the_longer_their_lists(
    passes: ModuleType, scene: Scene4D, camera: Camera, rendered: NDArray[np.uint8]
) -> None:
    _, *heats = panels(passes, passes.tiles(scene, camera), 3)
    listed, drawn = (heat.sum(axis=2) for heat in heats)
    assert (drawn <= listed).all()
    empty = rendered.sum(axis=2) == 0
    assert listed[empty].mean() < listed[~empty].mean()
