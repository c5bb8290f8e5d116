"""Surfaces of what stands still, by a plane sweep between still cameras."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lapgs_wgpu.data import Dataset, View
from lapgs_wgpu.data.plane_sweep import still_surface
from lapgs_wgpu.splat.camera import Camera

NORMAL, DISTANCE = np.array([0.2, 0.1, 1.0]), 4.0  # of the wall: NORMAL . point = DISTANCE
TEXTURE = ndimage.gaussian_filter(np.random.default_rng(0).random((200, 200, 3)), (1.5, 1.5, 0), mode="wrap")
TEXTURE = (TEXTURE - TEXTURE.min()) / np.ptp(TEXTURE)


def wall(camera: Camera) -> NDArray[np.uint8]:
    """A camera's image of the wall, which has a texture of 10 x 10 world units."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.linalg.solve(camera.K, np.stack([x.ravel(), y.ravel(), np.ones(x.size)])).T @ camera.T_cam_world[:3, :3]
    points = camera.position + rays * ((DISTANCE - NORMAL @ camera.position) / (rays @ NORMAL))[:, None]
    at = (points[:, :2] + 5.0).T * 20.0
    colors = [ndimage.map_coordinates(TEXTURE[..., c], at, order=1, mode="grid-wrap") for c in range(3)]
    return np.round(255 * np.stack(colors, axis=-1)).astype(np.uint8).reshape(camera.height, camera.width, 3)


def rig(count: int = 6, moments: int = 9) -> Dataset:
    """Cameras beside and above each other before the wall; something white passes by."""
    views = []
    for c in range(count):
        eye = np.array([0.25 * (c % 3) - 0.25, 0.25 * (c // 3), 0.0])
        camera = Camera.looking_at(eye, [0.0, 0.1, 4.0], up=[0, -1, 0], fov_x=0.8, width=80, height=60)
        still = wall(camera)
        for n in range(moments):

            def image(still: NDArray[np.uint8] = still, n: int = n) -> NDArray[np.uint8]:
                shown = still.copy()
                shown[20:40, 8 * n : 8 * n + 12] = 255
                return shown

            views.append(View(f"cam{c:02}_{n:04}", camera, n / (moments - 1), "made up", image))
    return Dataset("wall", tuple(views), (), depths=(2.0, 8.0))


def test_the_surface_is_where_the_wall_is() -> None:
    found = still_surface(rig())
    assert found is not None
    found = found._replace(points=found.points[:28_000], colors=found.colors[:28_000])  # then what moves
    off = np.abs(found.points @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)
    assert found.share > 0.75
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.99) < 0.1
    at = (found.points[:, :2].T + 5.0) * 20.0
    true = np.stack([ndimage.map_coordinates(TEXTURE[..., c], at, order=1, mode="grid-wrap") for c in range(3)], 1)
    assert np.abs(found.colors - true).mean() < 0.03


@pytest.mark.parametrize("lacking", ["cameras", "depths", "parallax"])
def test_other_captures_have_none(lacking: str) -> None:
    data = rig(2 if lacking == "cameras" else 4, 3)
    if lacking == "depths":
        data = dataclasses.replace(data, depths=None)
    if lacking == "parallax":
        first = data.train[0].camera
        same = {camera: dataclasses.replace(first) for camera in data.cameras}
        views = [dataclasses.replace(view, camera=same[view.camera]) for view in data.train]
        data = dataclasses.replace(data, train=tuple(views))
    assert still_surface(data) is None


def test_a_blank_surface_is_filled_in() -> None:
    """Half of the wall has no texture: its depths follow from those around it."""
    data = rig()
    blank = np.full(3, 128, np.uint8)

    def painted(view: View) -> View:
        def image() -> NDArray[np.uint8]:
            shown = wall(view.camera)
            y, x = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
            rays = np.linalg.solve(view.camera.K, np.stack([x.ravel(), y.ravel(), np.ones(x.size)])).T
            rays = rays @ view.camera.T_cam_world[:3, :3]
            depths = (DISTANCE - NORMAL @ view.camera.position) / (rays @ NORMAL)
            at = view.camera.position + rays * depths[:, None]
            inside = (np.abs(at[:, :2] - [0.0, 0.1]) < 0.6).all(axis=1)
            shown.reshape(-1, 3)[inside] = blank
            return shown

        return dataclasses.replace(view, load=image)

    found = still_surface(dataclasses.replace(data, train=tuple(painted(view) for view in data.train)))
    assert found is not None
    middle = (np.abs(found.points[:, :2] - [0.0, 0.1]) < 0.3).all(axis=1)
    off = np.abs(found.points[middle] @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)
    assert middle.sum() > 500
    assert np.quantile(off, 0.9) < 0.05


def test_moving_cameras_show_surfaces_too() -> None:
    data = rig(5, 3)
    own = [dataclasses.replace(view, camera=dataclasses.replace(view.camera)) for view in data.train]
    found = still_surface(dataclasses.replace(data, train=tuple(own)))
    assert found is not None
    assert np.median(np.abs(found.points @ NORMAL - DISTANCE)) < 0.02


def test_what_moves_starts_where_it_is_at_five_times(capsys: pytest.CaptureFixture[str]) -> None:
    """A square before the wall goes from left to right."""
    data = rig(6, 9)

    def passed(view: View) -> View:
        def image() -> NDArray[np.uint8]:
            camera, shown = view.camera, wall(view.camera)
            y, x = np.mgrid[: camera.height, : camera.width] + 0.5
            rays = np.linalg.solve(camera.K, np.stack([x.ravel(), y.ravel(), np.ones(x.size)])).T
            rays = rays @ camera.T_cam_world[:3, :3]
            at = camera.position + rays * ((2.8 - camera.position[2]) / rays[:, 2])[:, None]
            local = at[:, :2] - [1.6 * view.time - 0.8, 0.1]
            inside = (np.abs(local) < 0.3).all(axis=1)
            texture = (local[inside] * 40 + 100).astype(int)
            shown.reshape(-1, 3)[inside] = np.round(255 * TEXTURE[texture[:, 0], texture[:, 1], ::-1])
            return shown

        return dataclasses.replace(view, load=image)

    found = still_surface(dataclasses.replace(data, train=tuple(passed(view) for view in data.train)))
    assert found is not None
    assert "on what moves, at 5 times" in capsys.readouterr().out
    before = found.points[np.abs(found.points[:, 2] - 2.8) < 0.1]
    for time in (0.125, 0.25, 0.5, 0.75, 0.875):  # those of images next to a tenth, three tenths, and so on
        assert np.sum(np.abs(before[:, 0] - (1.6 * time - 0.8)) < 0.3) > 100, time
    assert np.quantile(np.abs(before[:, 0]), 0.95) < 1.0
