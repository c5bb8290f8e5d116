"""Views, compositing and the image cache."""

import dataclasses
import threading
from collections import Counter

import numpy as np
import pytest

from lapgs_wgpu.data import Dataset, View, composite
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.focus import focus_of, spread
from lapgs_wgpu.data.normalize import BOX
from lapgs_wgpu.data.views import spread_views
from lapgs_wgpu.splat.camera import Camera

CAMERA = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=5, height=4)
BYTES = 5 * 4 * 4


class Source:
    """Pixels that count how often they were decoded."""

    def __init__(self, value: int = 0, gate: threading.Event | None = None) -> None:
        self.value, self.gate, self.decodes = value, gate, 0
        self.lock = threading.Lock()

    def __call__(self) -> np.ndarray:
        with self.lock:
            self.decodes += 1
        if self.gate:
            assert self.gate.wait(10)
        return np.full((4, 5, 4), self.value, dtype=np.uint8)


def view_of(source: Source, name: str = "train_000", time: float = 0.0) -> View:
    return View(name=name, camera=CAMERA, time=time, source=f"{name}.png", load=source)


def rig(times: int, cameras: int) -> list[View]:
    """Named as Neu3D's: camera after camera."""
    return [view_of(Source(), f"cam{c:02}_{t:04}", t / (times - 1)) for c in range(cameras) for t in range(times)]


@pytest.mark.parametrize(
    ("count", "most", "chosen"),
    [(5, 9, [0, 1, 2, 3, 4]), (9, 3, [0, 4, 8]), (10, 4, [0, 3, 6, 9]), (3, 1, [0]), (0, 3, [])],
)
def test_some_of_many_are_spread_from_the_first_to_the_last(count: int, most: int, chosen: list[int]) -> None:
    assert evenly(range(count), most) == chosen


@pytest.mark.parametrize("count", [400, 130])
def test_views_are_spread_over_the_clip(count: int) -> None:
    many = [view_of(Source(), f"{i}", (i * 37 % count) / count) for i in range(count)]
    times = np.array([view.time for view in spread_views(many, 50)])
    assert np.abs(times - np.arange(50) / 50).max() <= 1 / 50
    assert np.diff(times).min() > 0


@pytest.mark.parametrize("size", [(300, 17), (300, 19), (100, 4), (50, 6), (50, 7), (50, 2), (10, 20)])
def test_views_are_spread_over_the_cameras_of_a_rig(size: tuple[int, int]) -> None:
    times, cameras = size
    chosen = spread_views(rig(times, cameras), 50)
    assert len(chosen) == len({view.name for view in chosen}) == 50
    seen = Counter(view.name[:5] for view in chosen)
    assert len(seen) == cameras
    assert max(seen.values()) <= 2 * 50 / cameras
    assert np.diff([view.time for view in chosen]).max() <= 0.12


def test_times_are_counted_by_one_still_camera() -> None:
    """Of cameras that are not in step; where each image has a camera of its own, there are as many as times."""
    other = dataclasses.replace(CAMERA)
    views = [
        dataclasses.replace(view_of(Source(), f"{c}_{t}", min(1.0, (t + 0.5 * c) / 10)), camera=camera)
        for c, camera in enumerate((CAMERA, other))
        for t in range(10)
    ]
    still = Dataset("rig", tuple(views), ())
    assert (still.still_cameras, len(still.times), still.time_count) == (True, 20, 10)
    assert still.time_gap == pytest.approx(1 / 9)
    walking = tuple(dataclasses.replace(view, camera=dataclasses.replace(CAMERA)) for view in views)
    moving = Dataset("walk", walking, ())
    assert (moving.still_cameras, moving.time_count) == (False, 20)
    assert moving.time_gap == pytest.approx(0.05)


def test_composite_rounds_to_nearest() -> None:
    color, alpha = (a.ravel() for a in np.meshgrid(np.arange(256), np.arange(256)))
    image = np.stack([color, color, color, alpha], axis=-1).astype(np.uint8)[None]
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 0.75)):
        got = composite(image, background)[0]
        exact = color * alpha / 255
        for channel, b in enumerate(background):
            assert np.abs(got[:, channel] - (exact + 255 * b * (1 - alpha / 255))).max() <= 0.5 + 1e-4
    assert composite(image, (0, 0, 0)).dtype == np.uint8


@pytest.mark.parametrize("count", [1, 3, 97])
def test_cameras_at_one_place_have_the_extent_of_the_scene(count: int) -> None:
    """Also where their mean is off by a rounding."""
    eye = np.array([0.1, -3.7, 1 / 3])
    camera = Camera.looking_at(eye, [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=5, height=4)
    views = [dataclasses.replace(view_of(Source()), camera=dataclasses.replace(camera)) for _ in range(count)]
    data = Dataset("toy", tuple(views), ())
    assert data.extent == BOX
    np.testing.assert_allclose(data.focus, [0, 0, 0], atol=1e-9)
    away = [dataclasses.replace(view.camera, T_cam_world=np.eye(4)) for view in views]  # the origin is not before it
    np.testing.assert_allclose(focus_of(away, origin=True), [0, 0, 1], atol=1e-9)
    assert spread([camera, CAMERA]) == pytest.approx(0.5 * np.linalg.norm(eye - CAMERA.position))
