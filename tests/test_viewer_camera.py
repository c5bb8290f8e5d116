"""The viewer's camera: what mouse moves leave as it was, and standing at a capture's camera."""

import dataclasses
import math

import numpy as np
import pytest

from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.camera import ViewCamera

UP = np.array([0.0, 0.6, 0.8])


@pytest.fixture
def view() -> ViewCamera:
    camera = Camera.looking_at([3.0, -1.0, 0.5], [0.2, 0.1, -0.3], up=UP, fov_x=0.7, width=100, height=100)
    return ViewCamera(camera, [0.2, 0.1, -0.3], UP)


def level(view: ViewCamera) -> bool:
    return abs(view.rotation[0] @ UP) < 1e-9 and view.rotation[1] @ UP < 0


def proper(view: ViewCamera) -> bool:
    rotation = view.rotation
    return np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0


def ahead(view: ViewCamera) -> bool:
    """Whether the focus is in the middle of the picture."""
    seen = view.rotation @ (view.focus - view.position)
    return bool(np.allclose(seen, [0, 0, view.distance]))


def test_orbit_keeps_focus_distance_and_horizon(view: ViewCamera) -> None:
    focus, distance = view.focus.copy(), view.distance
    for right, down in ((0.3, 0.2), (-2.0, 0.5), (1.0, -3.0), (0.1, 9.0), (4.0, -0.2)):
        view.orbit(right, down)
        assert np.allclose(view.focus, focus)
        assert view.distance == pytest.approx(distance)
        assert level(view)
        assert proper(view)
        assert ahead(view)


def test_pan_moves_the_focus_with_the_mouse(view: ViewCamera) -> None:
    focus, rotation = view.focus.copy(), view.rotation.copy()
    view.pan(0.25, -0.1)
    assert np.allclose(view.camera(400, 200).project(focus[None])[0], [[200 + 50, 100 - 20]])
    assert np.array_equal(view.rotation, rotation)


def test_a_new_focus_comes_to_the_middle(view: ViewCamera) -> None:
    position, point = view.position.copy(), np.array([-1.0, 2.0, 0.4])
    view.focus_on(point)
    assert np.array_equal(view.position, position)
    assert np.allclose(view.camera(400, 300).project(point[None])[0], [[200, 150]])
    assert level(view)


def captured() -> Camera:
    """A rolled camera with a principal point off the centre and unequal focal lengths."""
    camera = Camera.looking_at([1, -3, 0.7], [0.1, 0, 0], up=[0.3, 0.2, 1], fov_x=0.8, width=60, height=40)
    return Camera(camera.K * np.array([[1.0, 1, 1.1], [1, 1.15, 0.93], [1, 1, 1]]), camera.T_cam_world, 60, 40)


def test_a_rolled_camera_turns_without_a_jump() -> None:
    """The first drag after snapping moves as little as a drag does, and keeps the roll."""
    roll = 0.3
    turn = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    camera = Camera.looking_at([0, -4, 1], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=64, height=48)
    T = np.eye(4)
    T[:3, :3] = turn @ camera.T_cam_world[:3, :3]
    T[:3, 3] = -T[:3, :3] @ camera.position
    view = ViewCamera(Camera(camera.K, T, 64, 48), [0, 0, 0], [0, 0, 1])
    before = view.rotation
    view.orbit(1e-3, 1e-3)
    assert np.abs(view.rotation - before).max() < 3e-3
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
    view.orbit(0.5, 0.1)
    assert abs(view.rotation[0] @ view.up) == pytest.approx(abs(before[0] @ view.up), abs=0.05)


def test_a_camera_keeps_the_near_plane_of_where_it_starts(view: ViewCamera) -> None:
    """A capture's camera may stand in a wall, which must not hide what is before it; checkpoints hold the depth."""
    start = dataclasses.replace(view.camera(400, 300), near=0.2)
    again = InitialView.from_json(InitialView(start, view.focus, view.up, 10).to_json())
    assert again is not None
    moved = ViewCamera(again.camera, again.focus, again.up)
    moved.orbit(0.1, 0.0)
    assert moved.camera(200, 100).near == 0.2
    assert view.camera(200, 100).near == 0.0
