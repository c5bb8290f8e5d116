"""Frames of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lapgs_wgpu.viewer.choices import Mode
from lapgs_wgpu.viewer.frame import Frame, Painter, Request
from test_deform import GRID4D, trained
from test_playback import CAMERA

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.playback import open_playback

pytestmark = pytest.mark.kernels


def planes(frame: Frame) -> np.ndarray:
    width, height = frame.placed.picture
    return frame.placed.planes.read("uint32", (4, height, width))


@pytest.mark.parametrize("mode", ["motion", "scale"])
def test_the_first_frame_of_a_mode_is_of_its_own_time(device: Device, tmp_path: Path, mode: Mode) -> None:
    trained(device, GRID4D, 100).save(tmp_path / "scene.ply")
    painter = Painter(open_playback(tmp_path / "scene.ply", device))
    first, second = (planes(painter.draw(Request(CAMERA, 0.3, mode, (0, 0, 0)))) for _ in range(2))
    np.testing.assert_array_equal(first, second)
