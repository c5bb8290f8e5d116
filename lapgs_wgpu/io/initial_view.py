"""The initial view of the viewer, stored in the metadata of a checkpoint (docs/format.md, key `view`)."""

import json
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.splat.camera import Camera


class InitialView(NamedTuple):
    """Initial state of the viewer.

    camera: the initial camera. focus: (3,) center of orbiting, world units. up: (3,) unit vector.
    frames: number of frames of the clip. arc: degrees about `up` at the focus from the initial camera clockwise and
    counterclockwise (seen from above) to the last camera of the capture; None where cameras stand all around.
    """

    camera: Camera
    focus: NDArray[np.float64]
    up: NDArray[np.float64]
    frames: int
    arc: tuple[float, float] | None = None

    @property
    def narrowest(self) -> float:
        """Width by height of a picture, at most 1: in a narrower window a page shows more (viewer/web/camera.js)."""
        return min(max(self.camera.width / self.camera.height, 0.1), 1.0)

    def arc_from(self, camera: Camera) -> tuple[float, float] | None:
        """`arc`, counted from another camera."""
        if self.arc is None:
            return None
        turned = (_bearing(camera, self.focus, self.up) - _bearing(self.camera, self.focus, self.up) + 180) % 360 - 180
        return max(0.0, self.arc[0] + turned), max(0.0, self.arc[1] - turned)

    def to_json(self) -> str:
        """One line of JSON."""
        others = self._asdict()
        camera: Camera = others.pop("camera")
        values = {"K": camera.K, "T_cam_world": camera.T_cam_world, "size": (camera.width, camera.height)} | others
        return json.dumps(values | ({"near": camera.near} if camera.near else {}), default=np.ndarray.tolist)

    @staticmethod
    def from_json(text: str) -> "InitialView | None":
        """Parse the output of `to_json`. Returns None for any other text; the viewer then guesses a view."""
        with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
            values: dict[str, Any] = json.loads(text)
            width, height = values["size"]
            K, T = np.array(values["K"], float), np.array(values["T_cam_world"], float)
            camera = Camera(K, T, int(width), int(height), float(values.get("near", 0.0)))
            focus, up = np.array(values["focus"], float), np.array(values["up"], float)
            frames = max(1, min(int(values["frames"]), 1_000_000))
            arc: Any = None if values.get("arc") is None else tuple(map(float, values["arc"]))
            if (
                focus.shape == up.shape == (3,)
                and np.isfinite([focus, up]).all()
                and np.linalg.norm(up) > 1e-3
                and min(K[0, 0], K[1, 1]) > 0
                and max(camera.width, camera.height) <= 1 << 16
                and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3)
                and (arc is None or (len(arc) == 2 and min(arc) >= 0 and sum(arc) <= 360))
            ):
                return InitialView(camera, focus, up / np.linalg.norm(up), frames, arc)
        return None


def captured_arc(
    start: Camera, cameras: Sequence[Camera], focus: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[float, float] | None:
    """`InitialView.arc` of a capture: how far its cameras stand to either side of the camera `start`."""
    first = _bearing(start, focus, up)
    turned = sorted((_bearing(camera, focus, up) - first) % 360 for camera in cameras)
    bounds = [0.0, *turned, 360.0]
    widest = int(np.argmax(np.diff(bounds)))
    if bounds[widest + 1] - bounds[widest] < 90.0:  # cameras with no wider gap stand all around
        return None
    return 360 - bounds[widest + 1], bounds[widest]


def _bearing(camera: Camera, focus: NDArray[np.float64], up: NDArray[np.float64]) -> float:
    """Degrees counterclockwise about `up`, seen from above, at which a camera stands around the focus."""
    x = np.cross([1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0], up)
    out = camera.position - focus
    return float(np.degrees(np.arctan2(out @ np.cross(up, x), out @ x)))
