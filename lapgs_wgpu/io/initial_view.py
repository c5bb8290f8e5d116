"""The initial view of the viewer, stored in the metadata of a checkpoint (docs/format.md, key `view`)."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.splat.camera import Camera


class InitialView(NamedTuple):
    """Initial state of the viewer.

    camera: the initial camera. focus: (3,) center of orbiting, world units. up: (3,) unit vector.
    frames: number of frames of the clip.
    """

    camera: Camera
    focus: NDArray[np.float64]
    up: NDArray[np.float64]
    frames: int

    def to_json(self) -> str:
        """One line of JSON."""
        camera = self.camera
        values = {
            "K": camera.K.tolist(),
            "T_cam_world": camera.T_cam_world.tolist(),
            "size": [camera.width, camera.height],
            "focus": self.focus.tolist(),
            "up": self.up.tolist(),
            "frames": self.frames,
        }
        return json.dumps(values)

    @staticmethod
    def from_json(text: str) -> InitialView | None:
        """Parse the output of `to_json`. Returns None for any other text; the viewer then guesses a view."""
        try:
            values: dict[str, Any] = json.loads(text)
            width, height = values["size"]
            camera = Camera(
                np.array(values["K"], float), np.array(values["T_cam_world"], float), int(width), int(height)
            )
            focus, up = np.array(values["focus"], float), np.array(values["up"], float)
            usable = (
                focus.shape == up.shape == (3,)
                and bool(np.isfinite([focus, up]).all())
                and bool(np.linalg.norm(up) > 1e-3)
                and bool(camera.K[0, 0] > 0 and camera.K[1, 1] > 0)
                and max(camera.width, camera.height) <= 1 << 16
                and np.allclose(camera.T_cam_world[:3, :3] @ camera.T_cam_world[:3, :3].T, np.eye(3), atol=1e-3)
            )
            frames = int(values["frames"])
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
            return None
        return InitialView(camera, focus, up / np.linalg.norm(up), max(1, min(frames, 1_000_000))) if usable else None
