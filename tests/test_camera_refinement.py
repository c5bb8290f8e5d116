"""Cameras corrected while training: the corrections themselves, the step's gradient, and what they are for."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.disturbed_walk import disturbed_walk, pose_errors, turn_between
from helpers.image_losses import BACKGROUND, CAMERA, TRUTH, WEIGHTS, gaussians, gradients, step
from helpers.loss_reference import total
from helpers.scenes import relative
from helpers.training import configure
from scipy.spatial.transform import Rotation
from view_alignment import aligned_view

from lapgs_wgpu.data import Dataset
from lapgs_wgpu.data.views import View
from lapgs_wgpu.discovery.discover import start_training
from lapgs_wgpu.discovery.static_fit import static_config
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.drawing import camera_gradient
from lapgs_wgpu.splat.rasterize import upload_gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.train.camera_refinement import (
    CameraRefinement,
    ScenePoints,
    changed_camera,
    corrected_views,
    held_out_corrections,
    image_motion,
    whitening,
)
from lapgs_wgpu.train.config import CamerasConfig, Rate
from lapgs_wgpu.train.exchange_step import render_loss
from lapgs_wgpu.train.ground_truth import upload_rgba
from lapgs_wgpu.train.learners import restore_tensors
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.trainer import Trainer

CONFIG = CamerasConfig("on", Rate(1e-2, 1e-2, 1), 0.0, 1)
POINTS = ScenePoints(np.random.default_rng(1).uniform(-4, 4, (300, 3)), np.ones(300))


def refinement_of(given: list[Camera], config: CamerasConfig = CONFIG) -> CameraRefinement:
    return CameraRefinement(given, 2.0, config, lambda: POINTS)


def cameras(count: int = 5) -> list[Camera]:
    places = np.random.default_rng(0).uniform([-3, -11, -3], [3, -5, 3], (count, 3))
    return [Camera.looking_at(p, [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=40, height=30) for p in places]


def test_the_image_motion_is_the_derivative_of_the_projection() -> None:
    """Against finite differences of projected points, in focal lengths."""
    camera, unit, h = cameras()[0], 2.0, 1e-6

    def places(change: np.ndarray) -> np.ndarray:
        moved = changed_camera(camera, change * np.repeat([1.0, unit], 3))
        x, y, z = (POINTS.positions @ moved.T_cam_world[:3, :3].T + moved.T_cam_world[:3, 3]).T
        return np.stack([x / z, y / z], axis=1)

    u = places(np.zeros(6)) * camera.K[0, 0] + camera.K[:2, 2]
    inside = ((u >= 0) & (u < [camera.width, camera.height])).all(axis=1)
    assert 50 < inside.sum() < 300
    J = np.stack([(places(h * row) - places(-h * row)) / (2 * h) for row in np.eye(6)], axis=2)[inside]
    expected = np.einsum("nij,nik->jk", J, J) / inside.sum()
    found = image_motion(camera, POINTS, unit)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    white = whitening(found, 0.0)
    np.testing.assert_allclose(white @ found @ white, np.eye(6), atol=1e-9)
    assert not image_motion(
        camera, ScenePoints(POINTS.positions - 100 * camera.T_cam_world[2, :3], POINTS.weights), 1
    ).any()
    assert not whitening(np.zeros((6, 6)), 0.1).any()


def test_the_change_of_a_camera_is_that_of_the_gradient() -> None:
    """The first step goes down the whitened gradient, and moves the image by the learning rate."""
    given = cameras()
    refinement = refinement_of(given)
    refinement.common = torch.zeros(30, 0, dtype=torch.float64)
    gradient = torch.zeros(5, 6)
    gradient[1] = torch.tensor([0.3, -0.1, -0.3, 20.0, -5.0, 1.0])
    refinement.values.grad = gradient
    refinement.step(1)
    moved = refinement.refined(given[1])
    turn = Rotation.from_matrix(moved.T_cam_world[:3, :3].T @ given[1].T_cam_world[:3, :3]).as_rotvec()
    change = np.concatenate([turn, (moved.position - given[1].position) / 2.0])
    motion = image_motion(given[1], POINTS, 2.0)
    damped = motion + np.trace(motion) / 6 * np.eye(6)  # the damping starts at 1
    expected = -np.linalg.solve(damped, gradient[1].double().numpy())
    np.testing.assert_allclose(change / np.linalg.norm(change), expected / np.linalg.norm(expected), atol=1e-7)
    assert change @ damped @ change == pytest.approx(CONFIG.rate.start**2, rel=1e-6)
    for number in (0, 2, 3, 4):
        np.testing.assert_allclose(refinement.refined(given[number]).T_cam_world, given[number].T_cam_world, atol=1e-14)
    assert refinement.values.grad is None
    assert not refinement.values.any()
    report = refinement.report()
    assert report["rotation_degrees"]["largest"] == pytest.approx(np.degrees(np.linalg.norm(turn)))
    assert report["shift_percent"]["largest"] == pytest.approx(100 * np.linalg.norm(change[3:]))


def test_what_moves_all_cameras_alike_is_taken_out() -> None:
    """A shift, a turn and a scaling of the whole scene change no image."""
    given = cameras()
    arms = np.stack([c.position for c in given])
    arms = (arms - arms.mean(axis=0)) / 2.0
    axis = np.array([0.2, -0.5, 0.4])
    for change in (
        np.concatenate([np.zeros((5, 3)), np.tile(axis, (5, 1))], axis=1),
        np.concatenate([np.tile(axis, (5, 1)), np.cross(axis, arms)], axis=1),
        np.concatenate([np.zeros((5, 3)), arms], axis=1),
    ):
        refinement = refinement_of(given)
        refinement._learnt += torch.from_numpy(0.01 * change)
        refinement.values.grad = torch.zeros(5, 6)
        refinement.step(1)
        assert refinement._learnt.abs().max() < 1e-12
    refinement._learnt[2] += 0.01
    refinement.values.grad = torch.zeros(5, 6)
    refinement.step(2)
    assert refinement._learnt[2].abs().max() > 1e-3


def test_corrections_are_pulled_back() -> None:
    """Those of cameras with a gradient, by the rate times the pull."""
    pull, first = 0.5, torch.from_numpy(np.random.default_rng(2).normal(scale=0.02, size=(5, 6)))
    gradient = torch.randn(5, 6, generator=torch.Generator().manual_seed(0))
    gradient[[1, 4]] = 0.0
    pulled, twin = (refinement_of(cameras(), dataclasses.replace(CONFIG, pull=each)) for each in (pull, 0.0))
    for refinement in (pulled, twin):
        refinement.common = torch.zeros(30, 0, dtype=torch.float64)
        refinement._learnt.copy_(first)
        refinement.values.grad = gradient.clone()
        refinement.step(1)
    factor = 1 - CONFIG.rate.start * pull
    assert torch.equal(pulled._learnt[[0, 2, 3]], twin._learnt[[0, 2, 3]] * factor)
    assert torch.equal(pulled._learnt[[1, 4]], first[[1, 4]])


@pytest.mark.kernels
def test_a_step_has_the_gradient_of_its_camera(device: Device) -> None:
    """That of the rasterizer for the gradient of the reference's loss; and it changes no other gradient."""
    scene, other = gaussians(), gaussians()
    change = torch.zeros(6, requires_grad=True)
    truth = upload_rgba(device, TRUTH)
    done = render_loss(scene, CAMERA, truth, BACKGROUND, WEIGHTS["all"], device, camera_change=change, camera_unit=2.0)
    (3 * done.loss).backward()
    plain = step(device, other)
    (3 * plain.loss).backward()
    assert done.loss.item() == plain.loss.item()
    assert change.grad is not None
    for name, gradient in gradients(scene, done).items():
        assert torch.equal(gradient, gradients(other, plain)[name]), name

    rasterizer = Rasterizer(device)
    drawing = rasterizer.draw(upload_gaussians(rasterizer.pool, gaussians()), CAMERA, tuple(BACKGROUND.tolist()))
    assert not rasterizer.grow_on_overflow(drawing)
    image = torch.from_numpy(drawing.image.read()[:3]).permute(1, 2, 0).double().requires_grad_()
    total(image, torch.from_numpy(TRUTH.astype(np.float32) / 255).double(), WEIGHTS["all"]).backward()
    assert image.grad is not None
    d_image = np.zeros((4, CAMERA.height, CAMERA.width), np.float32)
    d_image[:3] = 3 * image.grad.permute(2, 0, 1).numpy()
    sums = rasterizer.backward(drawing, DeviceArray.upload(device, "d_image", d_image), camera=True).camera
    assert sums is not None
    rotation, position = camera_gradient(sums.read())
    expected = torch.tensor([*rotation, *(2.0 * position)])
    assert relative(change.grad, expected.float()) < 1e-4


@pytest.fixture(scope="module")
def refined_walk(device: Device) -> tuple[Trainer, list[Camera]]:
    """A training of 500 steps on poses that are off by 1 degree and 1 %, and the true ones."""
    data, true = disturbed_walk(100, 24, 1.0, 1.0)
    config = load_config("tiny", {"points.count": 6000, "discovery.steps": 500, "data.background": "black"})
    rate = dataclasses.replace(config.cameras.rate, steps=500)
    config = dataclasses.replace(config, cameras=dataclasses.replace(config.cameras, refine="on", start=60, rate=rate))
    with Trainer(static_config(config), data, device) as training:
        for _ in training:
            pass
    return training, true


@pytest.mark.nightly
def test_disturbed_poses_are_found_again(refined_walk: tuple[Trainer, list[Camera]]) -> None:
    training, true = refined_walk
    given = training.dataset.cameras
    before, after = pose_errors(given, true), pose_errors([training.cameras.refined(c) for c in given], true)
    assert np.median(before[0]) == pytest.approx(1, abs=0.1)
    assert np.median(after[0]) < 0.2 * np.median(before[0])
    assert np.median(after[1]) < 0.5 * np.median(before[1])  # 0.41 here, 0.2 after 1,500 steps (docs/data.md)


@pytest.mark.nightly
def test_test_time_alignment_finds_the_camera(refined_walk: tuple[Trainer, list[Camera]]) -> None:
    training, _ = refined_walk
    views, extent = training.dataset.test[:2], training.dataset.extent
    off = [changed_camera(view.camera, np.array([0.006, -0.004, 0.003, 0.004, 0, 0.004])) for view in views]
    moved = [dataclasses.replace(view, camera=camera) for view, camera in zip(views, off, strict=True)]
    near = [aligned_view(training.scene, view, torch.zeros(3), extent) for view in moved]
    assert training.psnr(near) > training.psnr(moved) + 2
    for found, camera, view in zip(near, off, views, strict=True):
        turn, before = (np.linalg.norm(turn_between(each, view.camera)) for each in (found.camera, camera))
        assert turn < 0.5 * before
    again = aligned_view(training.scene, moved[0], torch.zeros(3), extent).camera
    assert np.array_equal(again.T_cam_world, near[0].camera.T_cam_world)


def test_held_out_cameras_are_corrected_as_those_around_them(dataset: Dataset) -> None:
    given = cameras(5)
    turns = {camera: np.array([0.01, 0, -0.02, 0.1, 0.2, 0]) * i for i, camera in enumerate(given)}
    refinement = CameraRefinement(given, 2.0, CONFIG, lambda: POINTS, turns)
    shown = dataset.train[0]

    def view(name: str, time: float, camera: Camera) -> View:
        return dataclasses.replace(shown, name=name, time=time, camera=camera)

    train = [view(f"train_{i}", i / 4, camera) for i, camera in enumerate(given)]
    test = view("test_0", 0.3, given[0])
    data = dataclasses.replace(dataset, train=(*train[::2], *train[1::2]), test=(test,))
    corrections = held_out_corrections(refinement, data)
    np.testing.assert_allclose(corrections["test_0"], 1.2 * turns[given[1]], atol=1e-12)
    (corrected,) = corrected_views([test], corrections)
    np.testing.assert_array_equal(
        corrected.camera.T_cam_world, changed_camera(given[0], 1.2 * turns[given[1]]).T_cam_world
    )
    assert corrected_views(train, corrections) == train
    jumps = CameraRefinement(
        given, 2.0, CONFIG, lambda: POINTS, {camera: turns[given[1]] * (-1) ** i for i, camera in enumerate(given)}
    )
    assert held_out_corrections(jumps, data) == {}
    rig = dataclasses.replace(data, train=(*train, view("train_5", 0.5, given[0])))
    assert held_out_corrections(refinement, rig) == {}
    with pytest.raises(InputError, match="test_0 is not made of 6 numbers"):
        corrected_views([test], {"test_0": [1.0, "x"]})


@pytest.mark.parametrize(("refine", "own", "refined"), [("auto", True, True), ("auto", False, False),
                                                        ("on", False, True), ("off", True, False)])  # fmt: skip
def test_own_footage_is_refined(device: Device, dataset: Dataset, refine: str, own: bool, refined: bool) -> None:
    data = dataclasses.replace(dataset, own_footage=own)
    training = Trainer(configure("static", cameras__refine=refine), data, device)
    assert (training.cameras is not None) == refined
    training.close()


def test_what_discovery_corrected_stays_corrected(device: Device, dataset: Dataset) -> None:
    config = configure(cameras__refine="on", discovery__enabled="true", discovery__steps="20", discovery__size="32")
    with start_training(config, dataset, device) as training:
        assert training.cameras is not None
        start = [training.cameras.refined(camera) for camera in dataset.cameras]
        moved = [np.abs(a.T_cam_world - b.T_cam_world).max() for a, b in zip(start, dataset.cameras, strict=True)]
        assert np.count_nonzero(np.array(moved) > 1e-5) == len(dataset.cameras)
        training.step()  # at once, though cameras.start is later
        later = [training.cameras.refined(camera) for camera in dataset.cameras]
        assert any(np.abs(a.T_cam_world - b.T_cam_world).max() > 1e-7 for a, b in zip(start, later, strict=True))


def test_state_of_other_cameras_is_refused() -> None:
    state = refinement_of(cameras(4)).state()
    with pytest.raises(ValueError, match="camera learnt"):
        restore_tensors(refinement_of(cameras(5)).state(), state, "camera")
    state["square"] -= 1
    with pytest.raises(ValueError, match="negative"):
        restore_tensors(refinement_of(cameras(4)).state(), state, "camera")
