"""Camera paths and their files."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lapgs_wgpu.viewer.path import KeyFrame, Pose


def keys(seed: int = 0) -> list[KeyFrame]:
    rng = np.random.default_rng(seed)
    turns = Rotation.random(4, random_state=seed).as_matrix()
    moments, times = [0.0, 1.0, 1.5, 4.0], [0.0, 0.2, 0.8, 1.0]
    return [
        KeyFrame(second, time, Pose(rng.normal(size=3), turn, float(rng.uniform(0.4, 1.2))))
        for second, time, turn in zip(moments, times, turns, strict=True)
    ]


IDENTITY = np.eye(4).ravel().tolist()
SHIFTED = [1, 0, 0, 3, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def nerfstudio(**changes: Any) -> dict[str, Any]:
    """A path as nerfstudio's viewer saves it, without times."""
    values: dict[str, Any] = {
        "camera_type": "perspective",
        "render_height": 1080,
        "render_width": 1920,
        "fps": 30.0,
        "seconds": 2.5,
        "camera_path": [{"camera_to_world": m, "fov": 60.0, "aspect": 1.78} for m in (IDENTITY, SHIFTED)],
    }
    return values | changes
