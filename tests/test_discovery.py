"""Discovery: what a static fit loses is found in space and time, followed, and given to the field."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from motion_scenes import MotionScene, moving_objects, scene_cameras, trace
from motion_writer import write_motion
from object_metrics import degrees_beside
from raytrace import combine, pixel_means
from synthetic import cameras

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.views import small_views
from lapgs_wgpu.discovery import rigid_fit
from lapgs_wgpu.discovery.discover import RAMP_STEPS, discover, rows_with, start_training, tracks_in_images
from lapgs_wgpu.discovery.field_fit import fit_field
from lapgs_wgpu.discovery.residual import Residual
from lapgs_wgpu.discovery.static_fit import static_config, static_fit
from lapgs_wgpu.discovery.surface_points import PointClouds, Points, surface_points
from lapgs_wgpu.discovery.tracks import Tracks, find_tracks
from lapgs_wgpu.discovery.trajectories import find_trajectories
from lapgs_wgpu.discovery.turns import find_turns
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.run import train
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.image_metrics import differing_pixels
from lapgs_wgpu.train.optimizer import Optimizer
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import max_field_rates
from lapgs_wgpu.train.trainer import Trainer

RADIUS, BOX = 0.2, 1.3
QUICK = {
    "schedule.steps": "70",
    "discovery.steps": "60",
    "discovery.field_steps": "120",
    "points.count": "400",
    "field.width": "16",
    "field.static.levels": "4",
    "field.temporal.levels": "4",
}


def disc(camera: Camera, center: np.ndarray, color: tuple[float, float, float]) -> np.ndarray:
    """(H, W, 3) image of a ball on black."""
    seen = camera.T_cam_world[:3, :3] @ center + camera.T_cam_world[:3, 3]
    x = (np.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (np.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    inside = np.hypot(x[None] - seen[0] / seen[2], y[:, None] - seen[1] / seen[2]) < RADIUS / seen[2]
    return (inside[..., None] * np.array(color)).astype(np.float32)


def path(t: np.ndarray) -> np.ndarray:
    """(T, 3): one turn on a circle, four diameters wide."""
    return np.stack([0.8 * np.cos(2 * np.pi * t), 0.8 * np.sin(2 * np.pi * t), 0.2 + 0 * t], axis=1)


@pytest.fixture(scope="module")
def residuals() -> list[Residual]:
    """60 images of a ball that the static fit, black, has lost."""
    times = np.linspace(0, 1, 60)
    views = zip(cameras(60, 0, size=64), times, path(times), strict=True)
    black = np.zeros((64, 64, 3), np.float32)
    return [Residual(camera, float(t), disc(camera, center, (0.9, 0.5, 0.2)), black) for camera, t, center in views]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("motion") / "scene"
    return load_dataset(write_motion(folder, MotionScene(path=4, cycles=1), size=48, train_times=30, test_views=2))


def configure(**overrides: str) -> Config:
    given = {name.replace("__", "."): value for name, value in overrides.items()}
    return load_config("tiny", {**QUICK, **given})


# Residuals -----------------------------------------------------------------------------------------------------------


def test_moving_pixels_are_those_of_the_ball_and_not_of_blurred_texture() -> None:
    rng = np.random.default_rng(0)
    texture = np.repeat(np.repeat(rng.random((16, 16, 3)), 4, axis=0), 4, axis=1).astype(np.float32)
    shifted = np.roll(texture, 1, axis=1)
    assert differing_pixels(texture, shifted).mean() < 0.01
    image = texture.copy()
    image[20:32, 24:40] = (0.0, 2.0, 0.0)  # brighter than anything there
    found = differing_pixels(image, shifted)
    assert found[20:32, 24:40].mean() > 0.95
    found[18:34, 22:42] = False
    assert found.mean() < 0.01


def test_samples_beside_an_image_and_behind_a_camera_are_outside(residuals: list[Residual]) -> None:
    camera = residuals[0].camera
    ahead = camera.T_cam_world[2, :3]
    points = np.stack([camera.position + 3 * ahead, camera.position - 3 * ahead, camera.position + 0.5 * ahead + 9])
    assert residuals[0].sample(points.astype(np.float32))[2].tolist() == [True, False, False]


# Surface points ------------------------------------------------------------------------------------------------------


def test_surface_points_lie_on_the_ball_at_every_time(residuals: list[Residual]) -> None:
    clouds = surface_points(residuals, BOX)
    centers = path(clouds.times)
    counts = [len(cloud.scores) for cloud in clouds.clouds]
    assert min(counts) >= 10
    distances = np.concatenate(
        [np.linalg.norm(cloud.positions - c, axis=1) for cloud, c in zip(clouds.clouds, centers, strict=True)]
    )
    assert np.median(distances) < 1.2 * RADIUS
    assert (distances < 1.6 * RADIUS).mean() > 0.95
    assert np.allclose(np.concatenate([c.colors for c in clouds.clouds]), (0.9, 0.5, 0.2), atol=1e-5)


def test_what_is_residual_at_all_times_is_no_motion() -> None:
    times = np.linspace(0, 1, 30)
    black = np.zeros((64, 64, 3), np.float32)
    still = [
        Residual(camera, float(t), disc(camera, np.zeros(3), (1.0, 1.0, 1.0)), black)
        for camera, t in zip(cameras(30, 0, size=64), times, strict=True)
    ]
    pixels = sum(int(image.mask.sum()) for image in still)
    assert surface_points(still, BOX).total < 0.2 * pixels  # of a moving ball all of them


def test_images_without_motion_have_no_points(residuals: list[Residual]) -> None:
    empty = [Residual(r.camera, r.time, r.image, r.image) for r in residuals]
    clouds = surface_points(empty, BOX)
    assert clouds.total == 0
    assert find_tracks(clouds) is None


def test_colors_part_what_touches() -> None:
    clouds = balls(np.zeros((1, 3)), np.array([[RADIUS, 0, 0]]))
    points = clouds.clouds[0]
    assert not clouds.parts(points).any()
    part, red = clouds._replace(tint=BOX).parts(points), points.colors[:, 0] > 0.5
    assert not set(part[red]) & set(part[~red])


# Tracks --------------------------------------------------------------------------------------------------------------


def balls(*centers: np.ndarray, gone: range = range(0)) -> PointClouds:
    """Clouds of balls on paths (T, 3), seen from one side at a time; at the times `gone` there are no points."""
    rng = np.random.default_rng(1)
    times = np.linspace(0, 1, len(centers[0]))
    colors = ((0.9, 0.2, 0.2), (0.2, 0.8, 0.3), (0.2, 0.3, 0.9))
    clouds = []
    for i in range(len(times)):
        normals = rng.normal(size=(len(centers), 60, 3))
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        side = rng.normal(size=3)
        parts = [
            (center[i] + RADIUS * n[n @ side > 0], np.tile(color, ((n @ side > 0).sum(), 1)))
            for center, n, color in zip(centers, normals, colors, strict=False)
        ]
        positions, of_color = (np.concatenate(values).astype(np.float32) for values in zip(*parts, strict=True))
        count = 0 if i in gone else len(positions)
        clouds.append(Points(positions[:count], of_color[:count], np.full(count, 0.9, np.float32)))
    return PointClouds(times, tuple(clouds), BOX)


def errors(tracks: Tracks, center: np.ndarray) -> np.ndarray:
    """(T,) distance of the best part's median point from a ball's centre at each time, in radii."""
    every = [
        np.linalg.norm(np.median(tracks.paths[:, tracks.part == part], axis=1) - center, axis=1)
        for part in np.unique(tracks.part)
    ]
    return np.min(every, axis=0) / RADIUS


def fast_path(t: np.ndarray) -> np.ndarray:
    """(T, 3): five turns on the circle; at 100 times, 1.3 radii of the ball from one time to the next."""
    return path(np.mod(5 * t, 1.0))


def test_trajectories_follow_what_passes_its_own_radius_from_one_time_to_the_next() -> None:
    t = np.linspace(0, 1, 100)
    one, other = fast_path(t), np.stack([0.8 * np.cos(10 * np.pi * t), 0 * t, -0.7 + 0 * t], axis=1)
    found = find_trajectories(balls(one, other))[0]
    assert len(found) == 2
    for center in (one, other):
        apart = min((np.linalg.norm(each.centers - center, axis=1) for each in found), key=np.median)
        assert np.median(apart) < 0.8 * RADIUS
        assert (apart < 2 * RADIUS).mean() > 0.9


def test_a_trajectory_leaps_over_times_without_points() -> None:
    center = fast_path(np.linspace(0, 1, 120))  # a fifth of a turn
    ((found,),) = find_trajectories(balls(center, gone=range(50, 54)))
    assert not found.seen[50:54].any()
    assert found.seen[:50].mean() > 0.9
    assert found.seen[54:].mean() > 0.9
    assert (np.linalg.norm(found.centers - center, axis=1) < 1.5 * RADIUS).all()


def test_a_trajectory_does_not_change_over_to_another_color_at_a_crossing() -> None:
    t = np.linspace(-1, 1, 60)
    one, other = np.stack([0.9 * t, 0.25 + 0 * t, 0 * t], axis=1), np.stack([0 * t, 0.9 * t - 0.3, 0 * t], axis=1)
    found = find_trajectories(balls(one, other))[0]
    for center in (one, other):
        assert min(np.linalg.norm(each.centers - center, axis=1)[[0, 10, 50, 59]].max() for each in found) < RADIUS


def test_equal_things_that_meet_keep_their_own_trajectories() -> None:
    """Their points become one group, out of which each goes on as before."""
    t = np.linspace(0, 1, 100)
    swing = 0.7 * np.cos(4 * np.pi * t)
    one, other = np.stack([swing, 0 * t, 0.23 + 0 * t], axis=1), np.stack([0 * t, swing, -0.23 + 0 * t], axis=1)
    keep_their_own(one, other, t)


def test_equal_things_keep_their_own_trajectories_through_gaps_between_the_images() -> None:
    t = np.delete(np.linspace(0, 1, 120), [i for i in range(6, 114) if i % 17 < 6])
    keep_their_own(*(each.positions(t) for each in moving_objects(MotionScene(path=2, cycles=1))[:2]), t)


def test_equal_things_keep_their_own_trajectories_where_some_of_their_images_show_them_elsewhere() -> None:
    t, rng = np.linspace(0, 1, 120), np.random.default_rng(4)
    swing = 0.7 * np.cos(4 * np.pi * t)
    paths = np.stack([swing, 0 * t, 0.23 + 0 * t], axis=1), np.stack([0 * t, swing, -0.23 + 0 * t], axis=1)
    strays = [
        np.where(rng.random((120, 1)) < 0.15, *(rng.normal(size=(120, 3)) * s for s in (0.3, 0.06))) for _ in paths
    ]
    found = find_trajectories(grey(t, *(path + stray for path, stray in zip(paths, strays, strict=True))))[0]
    for center in paths:
        assert min(np.quantile(np.linalg.norm(each.centers - center, axis=1), 0.95) for each in found) < RADIUS


def keep_their_own(one: np.ndarray, other: np.ndarray, times: np.ndarray) -> None:
    found = find_trajectories(grey(times, one, other))[0]
    assert len(found) == 2
    for center in (one, other):
        assert min(np.linalg.norm(each.centers - center, axis=1).max() for each in found) < 1.5 * RADIUS


def grey(times: np.ndarray, *centers: np.ndarray) -> PointClouds:
    """Clouds of equal balls on paths (T, 3)."""
    clouds = tuple(cloud._replace(colors=0 * cloud.colors + 0.5) for cloud in balls(*centers).clouds)
    return PointClouds(times, clouds, BOX)


def test_patches_that_come_and_go_are_not_followed() -> None:
    """Six places, of which one at a time shows a ball: what a static fit only blurs looks like that."""
    rng = np.random.default_rng(3)
    places = rng.uniform(-0.8, 0.8, (6, 3))
    leaping = places[rng.integers(0, 6, 80)]
    assert find_tracks(balls(leaping)) is None


# Turns ---------------------------------------------------------------------------------------------------------------


TIMES = np.linspace(0, 1, 40)


def seen_turning(turns: float, times: np.ndarray, twists: int = 0) -> tuple[Tracks, list[Residual], np.ndarray]:
    """Tracks of a box's center that do not know its turns, the images of it, and its rotations (T, 3, 3)."""
    scene, size = MotionScene(path=1, cycles=1, turns=turns, twists=twists), 48
    box, count = moving_objects(scene)[1], len(times)
    black, images = np.zeros((size, size, 3), np.float32), []
    for camera, t in zip(scene_cameras(scene, "train", times, 0, size=size), times, strict=True):
        color, _ = combine([trace(scene, camera, float(t))[1]], 9 * size**2)
        images.append(
            Residual(camera, float(t), np.moveaxis(pixel_means(color, camera), 0, 2).astype(np.float32), black)
        )
    corners = np.random.default_rng(0).uniform(-1, 1, (40, 3)) * box.solid.half
    paths = (box.positions(times)[:, None] + corners).astype(np.float32)
    colors, part = np.full((40, 3), 0.5, np.float32), np.zeros(40, np.int64)
    tracks = Tracks(paths[count // 2], colors, part, paths, np.ones(paths.shape[:2], bool))
    return tracks, images, np.stack([box.turn(t) for t in times])


@pytest.mark.nightly
def test_a_part_that_turns_becomes_a_rigid_body(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rigid_fit, "STEPS", 400)
    tracks, images, true = seen_turning(0.8, TIMES)
    stands, found = find_turns(tracks, TIMES, images)
    assert degrees_beside(found[0], true).mean() < 15
    generator = torch.Generator().manual_seed(0)
    rigid, light = rigid_fit.rigid_tracks(tracks, stands, found, TIMES, images, device, generator)
    assert light[0].mean(axis=0) == pytest.approx(np.ones(rigid_fit.POINTS), abs=1e-4)
    arms = rigid.paths - rigid.paths.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.einsum("tni,nj->tij", arms, arms[20]))
    assert np.quantile(degrees_beside(left @ right, true), 0.9) < 6
    assert np.ptp(np.linalg.norm(arms, axis=2), axis=0).max() < 1e-3  # it keeps its shape


@pytest.mark.parametrize(("turns", "twists", "gaps"), [(2.0, 0, (24, 66)), (1 / 6, 2, ())])
def test_what_turns_through_gaps_or_to_and_fro_is_followed(turns: float, twists: int, gaps: tuple[int, ...]) -> None:
    times = np.delete(np.linspace(0, 1, 100), [i for gap in gaps for i in range(gap, gap + 6)])
    tracks, images, true = seen_turning(turns, times, twists)
    _, found = find_turns(tracks, times, images)
    assert degrees_beside(found[0], true).mean() < 6


def test_one_of_the_parts_of_a_thing_stands_for_it_and_it_need_not_turn() -> None:
    tracks, images, _ = seen_turning(0.0, TIMES)
    astray = tracks.paths + (np.arange(40) < 8)[:, None, None].astype(np.float32)
    both = Tracks(
        *(np.concatenate([each, each]) for each in tracks[:2]),
        np.repeat([0, 1], 40),
        np.concatenate([astray, tracks.paths], axis=1),
        np.concatenate([tracks.supported, tracks.supported], axis=1),
    )
    stands, found = find_turns(both, TIMES, images)
    assert stands.tolist() == [1, 1]
    assert not found


# The static fit and what it loses ------------------------------------------------------------------------------------


def still_scene(device: Device) -> Scene4D:
    """Opaque Gaussians at the origin."""
    points = 0.1 * np.random.default_rng(0).normal(size=(50, 3))
    return Scene4D.from_points(
        points, np.full((50, 3), 0.5), np.full(50, 0.05), FieldConfig(kind="static"), opacity=0.9, device=device
    )


def tracks_along(*paths: np.ndarray, spread: float = 0.03) -> Tracks:
    """Parts of 20 points around paths (T, 3)."""
    around = spread * np.random.default_rng(0).normal(size=(20, 3))
    every = np.concatenate([p[:, None] + around for p in paths], axis=1).astype(np.float32)
    part = np.repeat(np.arange(len(paths)), 20)
    return Tracks(every[0], np.full((len(part), 3), 0.7, np.float32), part, every, np.ones(every.shape[:2], bool))


def still_view(device: Device, width: int = 24, height: int = 16) -> tuple[Scene4D, Camera, np.ndarray]:
    """A static scene, a camera, and the image (height, width, 3) that it takes."""
    static = still_scene(device)
    camera = Camera.looking_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=width, height=height)
    return static, camera, static.render(camera, 0.5, torch.zeros(3)).image.numpy(force=True)


def test_parts_must_show_where_something_moves(device: Device) -> None:
    static, camera, still = still_view(device)
    images = []
    for i in range(3):
        shown = still.copy()
        shown[3:8, 2 + i : 7 + i] = 0.7
        images.append(Residual(camera, i / 2, shown, still))
    there = np.array([[-0.9 + 0.12 * i, 0.0, 0.3] for i in range(3)])
    elsewhere = there * [-1, 1, 1]
    times = np.array([0.0, 0.5, 1.0])
    kept = tracks_in_images(tracks_along(elsewhere, there), times, images, static, 0.0, together=False)
    assert kept is not None
    assert np.array_equal(kept.paths, tracks_along(there).paths)
    for together in (False, True):
        assert tracks_in_images(tracks_along(elsewhere), times, images, static, 0.0, together=together) is None


def test_parts_of_several_cameras_may_bring_the_images_nearer_instead(device: Device) -> None:
    """Here little of what a part changes moves; the more of what is there shows, the more it gains."""
    static, camera, still = still_view(device, 48, 32)
    part = tracks_along(np.tile([-0.7, 0.0, 0.2], (3, 1)), spread=0.1)
    scene = Scene4D(rows_with(static, part), static.field_config, device, sh_degree=static.sh_degree)
    change = scene.render(camera, 0.5, torch.zeros(3)).image.numpy(force=True) - still
    core = np.where(change > 0.5 * change.max(), change, 0.0)
    for strength, together, keeps in ((1.0, False, False), (1.0, True, True), (0.5, True, False)):
        images = [Residual(camera, i / 2, still + np.float32(strength) * core, still) for i in range(3)]
        assert images[0].mask.sum() < 0.5 * (change > 2 / 255).any(axis=2).sum()
        kept = tracks_in_images(part, np.array([0.0, 0.5, 1.0]), images, static, 0.0, together=together)
        assert (kept is not None) == keeps


def test_the_static_fit_has_no_motion_and_small_images(dataset: Dataset) -> None:
    config = static_config(configure(schedule__half_size_steps="20"))
    assert not config.schedule.halves(1)
    assert (config.field.kind, config.schedule.steps, config.schedule.warm_up) == ("static", 60, 60)
    view, other = small_views(
        [dataset.train[0], dataclasses.replace(dataset.train[1], camera=dataset.train[0].camera)], 32
    )
    assert view.camera is other.camera  # a camera that stands still remains one
    assert (view.camera.width, view.camera.height) == (32, 32)
    assert view.load().shape == (32, 32, 4)
    assert small_views(dataset.train[:1], 48) == [dataset.train[0]]


# The field, and all together -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", ["laplacian", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("grid4d", "hexplane", "mlp"))]
)
def test_every_field_learns_tracks(device: Device, kind: str) -> None:
    config = load_config("tiny", {k: v for k, v in QUICK.items() if k.startswith("field.")}, method=kind).field
    tracks = tracks_along(path(np.linspace(0, 1, 20)) * 0.5)
    scene = Scene4D.from_points(tracks.positions, tracks.colors, np.full(20, 0.05), config, device=device, seed=1)
    at_rest = np.linalg.norm(tracks.paths - tracks.positions, axis=2).mean()
    times, generator = np.linspace(0, 1, 20), torch.Generator().manual_seed(0)
    light = np.linspace(0.5, 1.5, 20, dtype=np.float32)[:, None].repeat(20, axis=1)
    error = fit_field(scene, tracks, times, 250, generator, lambda step: None, fades=False, light={0: light})
    assert error < {"laplacian": 0.35, "grid4d": 0.35, "hexplane": 0.65, "mlp": 0.65}[kind] * at_rest
    brighter = float((scene.at(1.0).sh - scene.at(0.0).sh).detach()[:, 0].mean())
    assert (brighter > 1e-3) == (kind == "laplacian")  # the only one whose colors change


@pytest.fixture(scope="module")
def started(dataset: Dataset, device: Device) -> tuple[str, dict[str, np.ndarray]]:
    """What discovery found, and the state of the training that starts from it."""
    with start_training(configure(), dataset, device) as training:
        assert training.discovery is not None
        return training.discovery, training.state()


def test_discovery_starts_a_training_which_goes_on_to_the_same_bits(
    started: tuple[str, dict[str, np.ndarray]], dataset: Dataset, device: Device
) -> None:
    summary, state = started
    assert "moving parts" in summary
    assert state["training.warm_up"] == 0
    states = []
    with Trainer(configure(), dataset, device) as whole:
        whole.restore(state)
        whole.step()
        field = whole.scene.field
        assert field is not None
        assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in field.parameters())  # from the first step on
        assert not np.array_equal(state["gaussians.means"], whole.scene.parameters["means"].numpy(force=True))
        for _ in range(8):
            states.append(whole.state())
            whole.step()
        expected = whole.state()
    with Trainer(configure(), dataset, device) as resumed:
        resumed.restore(states[3])
        for _ in range(5):
            resumed.step()
        ours = resumed.state()
    assert ours.keys() == expected.keys()
    for name, value in expected.items():
        assert np.array_equal(ours[name], value), name


def test_a_training_draws_a_scene_that_it_starts_from_as_it_is_drawn(dataset: Dataset, device: Device) -> None:
    config = configure()
    scene = Scene4D.from_points(np.zeros((3, 3)), np.zeros((3, 3)), np.ones(3), config.field, device=device)
    with pytest.raises(InputError, match="antialiased = False, and the configuration says 0"):
        Trainer(config, dataset, device, scene=scene)


def test_rates_rise_after_discovery(
    started: tuple[str, dict[str, np.ndarray]], dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And on from where they were in a training that is resumed; over the last steps they fall."""
    shares: list[float] = []
    step = Optimizer.step

    def noted(self: Optimizer, number: int, share: float = 1.0) -> None:
        shares.append(share)
        step(self, number, share)

    monkeypatch.setattr(Optimizer, "step", noted)
    ramp = configure().schedule.warm_up or RAMP_STEPS
    state = started[1]
    for _ in range(2):
        with Trainer(configure(), dataset, device) as training:
            training.restore(state)
            training.step()
            state = training.state()
    with Trainer(configure(schedule__steps="4", schedule__cool_down="0.75"), dataset, device) as training:
        list(training)
    assert shares == pytest.approx([1 / ramp, 2 / ramp, 1, 1, 2 / 3, 1 / 3])


def test_a_field_that_knows_the_tracks_learns_slowly_also_when_resumed(
    started: tuple[str, dict[str, np.ndarray]], dataset: Dataset, device: Device
) -> None:
    config = configure()
    assert config.rates.mlp.start > max_field_rates(["mlp"])["mlp"]
    with Trainer(config, dataset, device) as resumed:
        assert resumed._learners.optimizer.highest == {}
        resumed.restore(started[1] | {"training.field_fitted": np.array(0.1)})
        assert resumed._learners.optimizer.highest == max_field_rates(["hash", "mlp"], 0.1)


@pytest.mark.nightly
def test_without_parts_to_follow_the_static_fit_starts_a_training(dataset: Dataset, device: Device) -> None:
    config = configure(discovery__least="1")
    static, *_ = static_fit(config, dataset, device, lambda step: None)
    found = discover(config, dataset, device)
    assert "nothing is added" in found.summary
    assert found.scene.parameters["dynamics"].abs().sum() == 0
    ours, theirs = found.scene.parameters["means"], static.parameters["means"]
    assert np.array_equal(np.sort(ours.numpy(force=True), axis=0), np.sort(theirs.numpy(force=True), axis=0))


@pytest.mark.nightly
def test_a_whole_run_repeats_to_the_last_byte(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    for name in ("one", "other"):
        train(configure(), dataset, tmp_path / name, device=device)
    one, other = ((tmp_path / name / "checkpoint.ply").read_bytes() for name in ("one", "other"))
    assert one == other


def test_images_that_show_nothing_are_refused(dataset: Dataset, device: Device) -> None:
    def empty() -> np.ndarray:
        return np.zeros((48, 48, 4), np.uint8)

    views = tuple(dataclasses.replace(view, load=empty) for view in dataset.train)
    with pytest.raises(InputError, match="show nothing but the black background"):
        discover(configure(discovery__steps="4"), dataclasses.replace(dataset, train=views), device)


def test_short_trainings_go_without(
    dataset: Dataset, device: Device, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    train(configure(schedule__steps="3", schedule__warm_up="1"), dataset, tmp_path / "run", device=device)
    told = capsys.readouterr()
    assert "discovery" not in told.out
    assert "motion discovery is left out" in told.err
