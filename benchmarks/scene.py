"""The scenes that are timed, the same for every rasterizer that is compared: a ball of Gaussians, in the order in which
a training keeps them, and what a training left in its checkpoint."""

import argparse
import math
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu import Camera
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.scene import Scene4D, load
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.morton import morton_order

BALL_RADIUS, CAMERA_DISTANCE, FOV = 1.3, 4.0, 0.69  # the field of view along the shorter side, radians
MEAN_SCALE, SPREAD = 0.02, 0.3  # standard deviations are log-normal; the mean shrinks so that the ball stays as full


@dataclass(frozen=True)
class SceneSize:
    """Named as in "50k@400x400": Gaussians, width and height of the image."""

    gaussians: int
    width: int
    height: int

    @staticmethod
    def parse(name: str) -> "SceneSize":
        found = re.fullmatch(r"(\d+)([kM]?)@(\d+)x(\d+)", name)
        if found is None:
            raise argparse.ArgumentTypeError(
                "expected GAUSSIANS@WIDTHxHEIGHT, such as 50k@400x400, or CHECKPOINT.ply@WIDTHxHEIGHT, such as "
                f"runs/demo/checkpoint.ply@400x400, got {name!r}"
            )
        count = int(found[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[found[2]]
        return SceneSize(count, int(found[3]), int(found[4]))

    def make(self) -> tuple[dict[str, NDArray[np.float32]], Camera]:
        """See `make_scene`."""
        return make_scene(self)

    def __str__(self) -> str:
        count = str(self.gaussians)
        for zeros, letter in (("000000", "M"), ("000", "k")):
            if count.endswith(zeros):
                count = count.removesuffix(zeros) + letter
        return f"{count}@{self.width}x{self.height}"


@dataclass(frozen=True)
class TrainedScene:
    """Named as in "runs/demo/checkpoint.ply@400x400": a checkpoint, as it is in the middle of its clip, seen by the
    camera from which the viewer opens it, at another size."""

    checkpoint: Path
    width: int
    height: int

    @staticmethod
    def parse(name: str) -> "TrainedScene":
        found = re.fullmatch(r"(.+\.ply)@(\d+)x(\d+)", name)
        if found is None or not Path(found[1]).is_file():
            raise argparse.ArgumentTypeError(f"expected CHECKPOINT.ply@WIDTHxHEIGHT, and the file to exist: {name!r}")
        return TrainedScene(Path(found[1]), int(found[2]), int(found[3]))

    def __str__(self) -> str:
        return f"{self.checkpoint}@{self.width}x{self.height}"

    @cached_property
    def _scene(self) -> Scene4D:
        return load(self.checkpoint)

    @property
    def gaussians(self) -> int:
        return len(self._scene)

    def make(self) -> tuple[dict[str, NDArray[np.float32]], Camera]:
        """Activated Gaussians with the constant part of their colors, as `make_scene`, and the camera."""
        view = InitialView.from_json(self._scene.metadata.get("view", ""))
        if view is None:
            raise SystemExit(
                f"{self.checkpoint} does not say from where it is looked at: it is no checkpoint of a training"
            )
        with torch.no_grad():
            gaussians = self._scene.at(0.5)
        arrays = {
            name: getattr(gaussians, name).numpy(force=True) for name in ("means", "quats", "scales", "opacities")
        }
        colors = 0.5 + CONSTANTS["SH_C0"] * gaussians.sh[:, 0].numpy(force=True)
        arrays["colors"] = np.ascontiguousarray(colors.clip(0, 1), np.float32)
        return arrays, view.camera.resized(self.width, self.height)


def parse_scene(name: str) -> SceneSize | TrainedScene:
    """The scene of a name on the command line."""
    return TrainedScene.parse(name) if ".ply@" in name else SceneSize.parse(name)


FIXED_SET = [SceneSize(n, *size) for size in ((400, 400), (1920, 1080)) for n in (50_000, 200_000, 1_000_000)]


def make_scene(size: SceneSize) -> tuple[dict[str, NDArray[np.float32]], Camera]:
    """Activated Gaussians as `rasterize` takes them (colors: RGB), and a camera that sees the whole ball."""
    count, width, height = size.gaussians, size.width, size.height
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = direction * (BALL_RADIUS * rng.random((count, 1)) ** (1 / 3))
    means = means[morton_order(torch.from_numpy(means)).numpy()]
    mean_scale = MEAN_SCALE * (50_000 / count) ** (1 / 3)
    scales = np.exp(rng.normal(np.log(mean_scale) - SPREAD**2 / 2, SPREAD, (count, 3)))
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = rng.uniform(0.05, 0.95, count)
    colors = rng.random((count, 3))
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    fov_x = 2 * math.atan(math.tan(FOV / 2) * width / min(width, height))
    camera = Camera.looking_at(
        [0, 0, -CAMERA_DISTANCE], [0, 0, 0], up=[0, -1, 0], fov_x=fov_x, width=width, height=height
    )
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}, camera


def save_scene(path: Path, arrays: dict[str, NDArray[np.float32]], camera: Camera) -> None:
    """Write it as .npz, with K (3, 3), T_cam_world (4, 4), width and height, for other rasterizers to read."""
    K, T_cam_world = camera.K.astype(np.float32), camera.T_cam_world.astype(np.float32)
    sizes = {"width": np.int64(camera.width), "height": np.int64(camera.height)}
    given: dict[str, Any] = {"K": K, "T_cam_world": T_cam_world, **sizes, **arrays}
    np.savez(path, **given)
