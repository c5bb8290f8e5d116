"""Movers that masks show: cut-outs that are followed, and the cube in which things move."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.films import Board, drawn, room_cloud, walk

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.mover_cube import mover_cube
from lapgs_wgpu.discovery.cutouts import cutout_tracks
from lapgs_wgpu.discovery.residual import Residual

BOARD = Board(0.4, 0.6, 0.7)
CAMERAS = walk(10, 128, 96)
TIMES = [i / (len(CAMERAS) - 1) for i in range(len(CAMERAS))]
TAKEN = [drawn(camera, t, BOARD) for camera, t in zip(CAMERAS, TIMES, strict=True)]
FAR = 5.0  # depth of what stands still


def residuals(*, moving: bool = True) -> list[Residual]:
    return [
        Residual(camera, t, image.astype(np.float32) / 255, image.astype(np.float32) / 255, mask & moving)
        for camera, t, (image, mask) in zip(CAMERAS, TIMES, TAKEN, strict=True)
    ]


def test_cutouts_show_what_moves_where_it_is_in_each_image() -> None:
    depths = [np.full(mask.shape, FAR, np.float32) for _, mask in TAKEN]
    tracks, share = cutout_tracks(residuals(), depths, 1.3)
    assert tracks is not None
    assert share > 0.9
    for i, (camera, (image, mask)) in enumerate(zip(CAMERAS, TAKEN, strict=True)):
        seen = tracks.supported[i]
        pixels, depth = camera.project(tracks.paths[i, seen])
        assert depth == pytest.approx(0.97 * FAR, abs=1e-3)
        x, y = pixels.astype(int).clip(0, [[127, 95]]).T
        assert mask[y, x].mean() > 0.9
        shown = np.zeros_like(mask)
        shown[y, x] = True
        assert np.abs(image[y, x] / 255 - tracks.colors[seen]).mean() < 0.06
        assert shown[mask].mean() > 0.4  # no more than a point a pixel


def test_nothing_moves_where_masks_are_black() -> None:
    assert cutout_tracks(residuals(moving=False), [np.full((96, 128), FAR, np.float32)] * 10, 1.3) == (None, 0.0)


def test_the_cube_of_movers_holds_them_and_not_the_room() -> None:
    points, colors = room_cloud(400, 0.0)
    seen = [(camera, lambda mask=mask: mask) for camera, (_, mask) in zip(CAMERAS, TAKEN, strict=True)]
    cube = mover_cube(Cloud(points, colors.astype(np.float32)), seen)
    assert cube is not None
    room = np.ptp(points, axis=0).max() / 2
    assert 0.4 < cube.half < 0.8 * room
    for camera, (_, mask) in zip(CAMERAS, TAKEN, strict=True):  # its middle is seen where the board is
        pixel, depth = camera.project(cube.center[None])
        rows, columns = np.nonzero(mask)
        assert depth[0] > 0
        assert abs(pixel[0, 0] - columns.mean()) < 64
        assert abs(pixel[0, 1] - rows.mean()) < 48
    empty = [(CAMERAS[0], lambda: np.zeros((96, 128), bool))]
    assert mover_cube(Cloud(points, colors.astype(np.float32)), empty) is None
