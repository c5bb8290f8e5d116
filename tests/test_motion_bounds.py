"""Which Gaussians a passing picture needs, by what was seen of their motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers.reference import project

from lapgs_wgpu.motion.playback.motion_bounds import MotionBounds
from lapgs_wgpu.splat.camera import Camera

PARTS = 16
# 100 pixels a world unit at the distance of the origin.
CAMERA = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=2 * np.arctan(0.2), width=160, height=120)


def gaussians(count: int, seed: int = 0) -> np.ndarray:
    """(count, 14), within the picture, of 0.05 world units."""
    values = np.zeros((count, 14), np.float32)
    values[:, :3] = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, 3))
    values[:, 3], values[:, 7:10], values[:, 10] = 1, 0.05, 0.5
    return values


def seen(at: Callable[[float], np.ndarray], parts: int = PARTS) -> MotionBounds:
    """The bounds of Gaussians that are at(t), (count, 14), after the first parts of the clip were seen."""
    bounds = MotionBounds(len(at(0.0)), PARTS)
    for part in range(parts):
        bounds.add(at((part + 0.5) / PARTS), (part + 0.5) / PARTS)
    return bounds


@pytest.mark.parametrize(
    ("column", "change", "expected"),
    [
        (0, 0.002, False),  # of the mean: 0.2 pixels
        (0, 0.003, True),
        (1, 0.003, True),  # along the camera's axis: nearer ones than it come out, too
        (4, 0.02, False),  # of the quaternion: 0.05 world units from the mean it turns by twice that
        (4, 0.03, True),
        (8, 0.002, False),
        (8, 0.003, True),
        (10, 0.01, False),
        (10, 0.02, True),
        (12, 0.05, False),  # times 0.28
        (12, 0.06, True),
    ],
)
def test_what_hardly_changes_is_not_needed(column: int, change: float, expected: bool) -> None:
    still = gaussians(20)
    way = np.zeros((20, 14), np.float32)
    way[::2, column] = change
    found = seen(lambda t: still + np.float32(t < 0.3) * way).needed(0.5, CAMERA)
    assert found.tolist() == 10 * [expected, False]


@pytest.mark.parametrize(
    ("column", "off", "expected"),
    [(0, 0.007, False), (0, 0.011, True), (8, 0.007, False), (8, 0.011, True), (10, 0.01, False), (10, 0.02, True)],
)
def test_what_moves_is_not_needed_where_other_values_are_near(column: int, off: float, expected: bool) -> None:
    """By a pixel; at times whose part of the clip was not seen, too."""
    still = gaussians(20)
    way = np.zeros((20, 14), np.float32)
    way[:, 0] = 0.1
    bounds = seen(lambda t: still + np.float32(t) * way, 9)
    error = np.zeros((14, 20), np.float32)
    error[column, ::2] = off
    assert bounds.needed(0.5, CAMERA).all()
    assert bounds.needed(0.5, CAMERA, error).tolist() == 10 * [expected, False]
    assert bounds.needed(0.9, CAMERA, error).tolist() == 10 * [expected, False]
    error[3, 1] = np.nan
    assert bounds.needed(0.5, CAMERA, error)[1]


def test_nearer_motion_counts_more() -> None:
    values = gaussians(2)
    values[:, :3] = [0, 0, 0], [0, -3, 0]
    way = np.zeros((2, 14), np.float32)
    way[:, 2] = 0.002
    assert seen(lambda t: values + np.float32(t) * way).needed(0.5, CAMERA).tolist() == [False, True]


def test_all_are_needed_at_times_of_which_too_little_was_seen() -> None:
    values = gaussians(5)
    assert MotionBounds(5, PARTS).needed(0.1, CAMERA).all()
    assert seen(lambda t: values, 7).needed(0.1, CAMERA).all()
    bounds = seen(lambda t: values, 8)
    assert not bounds.needed(0.0, CAMERA).any()
    assert not bounds.needed(0.49, CAMERA).any()
    assert bounds.needed(0.51, CAMERA).all()
    assert bounds.needed(1.0, CAMERA).all()
    bounds.add(values, 1.0)
    assert not bounds.needed(1.0, CAMERA).any()
    bounds.add(values, None)
    assert bounds.needed(0.6, CAMERA).all()


def test_values_of_several_times_widen_the_bounds() -> None:
    values = gaussians(5)
    bounds = seen(lambda t: values)
    moved = values.copy()
    moved[3, 0] += 0.1
    bounds.add(moved, None)
    assert bounds.needed(0.5, CAMERA).tolist() == [False, False, False, True, False]


def test_what_is_not_finite_is_needed() -> None:
    values = gaussians(3)
    values[0, 1], values[1, 8] = np.nan, np.inf
    assert seen(lambda t: values).needed(0.5, CAMERA).tolist() == [True, True, False]


@pytest.mark.parametrize("seed", range(8))
def test_what_shows_is_needed_and_little_else(seed: int) -> None:
    """Against the reference's projection, from within a cloud of Gaussians of very different sizes."""
    random = np.random.default_rng(seed)
    count = 4000
    values = gaussians(count)
    values[:, :3] = random.normal(0, 3, (count, 3))
    values[:, 3:7] = random.normal(size=(count, 4))
    values[:, 7:10] = np.exp(random.normal(-4, 1, (count, 3)))
    off = values.copy()
    values[:, 10] = 1.0
    off[:, 10] = 0.0  # so that none stands still
    camera = Camera.looking_at(random.normal(size=3), [0, 0, 0], up=[0, 0, 1], fov_x=0.9, width=160, height=120)
    needed = seen(lambda t: off if t < 0.5 else values).needed(0.7, camera)
    tensors = [torch.from_numpy(values[:, part]).double() for part in (slice(3), slice(3, 7), slice(7, 10))]
    projection = project(*tensors, torch.ones(count).double(), camera)
    corners = projection.means2d + torch.stack([-projection.half_sides, projection.half_sides])
    size = torch.tensor([camera.width, camera.height])
    shows = (projection.visible & (corners[1] > 0).all(1) & (corners[0] < size).all(1)).numpy()
    assert 100 < shows.sum() < 0.5 * count
    assert needed[shows].all()
    assert needed.sum() < 1.2 * shows.sum()
