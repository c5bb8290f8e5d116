"""The gradient by the camera against finite differences of the float64 reference."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers import reference
from helpers.scenes import front_camera, oblique_camera, random_scene
from scipy.spatial.transform import Rotation

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.drawing import camera_gradient
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import upload_gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer

pytestmark = pytest.mark.kernels

STEP = 1e-7  # small, since alpha jumps where it is cut off at 1/255


def disturbed(camera: Camera, change: np.ndarray) -> Camera:
    """change: (6,) rotation about the center along the world's axes, shift of the center."""
    T = camera.T_cam_world.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(change[:3]).as_matrix().T
    T[:3, 3] = -T[:3, :3] @ (camera.position + change[3:])
    return Camera(camera.K, T, camera.width, camera.height)


def expected(
    monkeypatch: pytest.MonkeyPatch,
    scene: dict[str, torch.Tensor],
    camera: Camera,
    weights: np.ndarray,
    **how: Any,
) -> np.ndarray:
    """(6,) by central differences. The limits of the Jacobian count as constants, as for the Gaussians' gradients."""
    limits = reference._frustum_limits(camera)
    monkeypatch.setattr(reference, "_frustum_limits", lambda _: limits)
    tensors = {name: value.double() for name, value in scene.items()}

    def loss(change: np.ndarray) -> float:
        image = reference.rasterize_reference(**tensors, camera=disturbed(camera, change), **how).image
        return float((image * torch.from_numpy(weights).double()).sum())

    return np.array([(loss(STEP * row) - loss(-STEP * row)) / (2 * STEP) for row in np.eye(6)])


def found(
    device: Device,
    scene: dict[str, torch.Tensor],
    camera: Camera,
    weights: np.ndarray,
    *,
    antialiased: bool | float = False,
) -> tuple[np.ndarray, np.ndarray]:
    rasterizer = Rasterizer(device)
    tensors = {"sh" if name == "colors" else name: value for name, value in scene.items()}
    gaussians = upload_gaussians(rasterizer.pool, Gaussians(**tensors, antialiased=antialiased))
    planes = np.concatenate([np.moveaxis(weights, 2, 0), np.zeros((1, *weights.shape[:2]))]).astype(np.float32)
    while True:
        drawing = rasterizer.draw(gaussians, camera)
        if not rasterizer.grow_on_overflow(drawing):
            break
    done = rasterizer.backward(drawing, DeviceArray.upload(device, "d_image", planes), camera=True)
    assert done.camera is not None
    sums = done.camera.read()
    return np.concatenate(camera_gradient(sums)), sums


@pytest.mark.parametrize(("sh", "antialiased"), [(None, False), (0, False), (2, False), (0, True), (0, 0.1)])
@pytest.mark.parametrize(("count", "camera"), [(70, front_camera(32, 24)), (150, oblique_camera(61, 47))])
def test_camera_bwd(
    monkeypatch: pytest.MonkeyPatch,
    device: Device,
    sh: int | None,
    antialiased: bool | float,
    count: int,
    camera: Camera,
) -> None:
    scene = random_scene(count, 1, sh=None if sh is None else (sh + 1) ** 2)
    weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))
    weights = weights.astype(np.float32).astype(np.float64)
    mine, _ = found(device, scene, camera, weights, antialiased=antialiased)
    theirs = expected(monkeypatch, scene, camera, weights, sh_degree=sh, antialiased=antialiased)
    least = 1e-2 * np.linalg.norm(theirs)  # a part may be what is left of terms that cancel
    for part in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(mine[part] - theirs[part])
        assert error < 1e-4 * max(np.linalg.norm(theirs[part]), least), (mine, theirs)


def test_the_same_bits_on_every_run(device: Device) -> None:
    camera, scene = oblique_camera(61, 47), random_scene(1000, 1, sh=4)
    weights = np.ones((47, 61, 3))
    _, one = found(device, scene, camera, weights)
    _, other = found(device, scene, camera, weights)
    assert one.shape == (2, 16, 4)
    assert np.array_equal(one, other)


def test_nothing_in_view(device: Device) -> None:
    """Gaussians behind the camera, at its center's depth, give zeros."""
    camera = front_camera(32, 24)
    scene = random_scene(70, 1)
    scene["means"] = torch.from_numpy(np.repeat(camera.position[None], 70, axis=0)).float()
    _, sums = found(device, scene, camera, np.ones((24, 32, 3)))
    assert not sums.any()
