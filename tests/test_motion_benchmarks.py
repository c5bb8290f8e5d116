"""The motion scenes: known paths, masks where the renderings show the objects, names on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lapgs_wgpu import cli
from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.builtin import builtin_folder, is_builtin, parse_motion
from lapgs_wgpu.data.motion_scenes import MotionScene, moving_objects, scene_cameras, trace
from lapgs_wgpu.data.motion_writer import write_motion
from lapgs_wgpu.data.raytrace import combine
from lapgs_wgpu.errors import InputError

SMALL: dict[str, Any] = {"size": 32, "train_times": 4, "test_views": 3}
TIMES = np.linspace(0, 1, 201)
SCENES = [
    *(MotionScene(path=path) for path in (0.5, 1, 2, 4, 8)),
    MotionScene(camera="walk", background="room"),
    MotionScene(camera="still", background="room"),
    MotionScene(path=4, objects="occluded"),
]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("path", [0.5, 1, 2, 4, 8])
@pytest.mark.parametrize("cycles", [0.5, 1, 5])
def test_paths_are_as_wide_and_as_often_travelled_as_asked(path: float, cycles: float) -> None:
    moving = [one for one in moving_objects(MotionScene(path=path, cycles=cycles)) if one.moves]
    assert [one.name for one in moving] == ["ball", "box"]
    for one in moving:
        places = one.positions(TIMES)
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)
        assert apart.max() == pytest.approx(path * one.diameter, rel=1e-3)
        assert one.positions([0.0]) == pytest.approx(one.positions([1 / cycles]))


@pytest.mark.parametrize("scene", SCENES, ids=str)
def test_objects_stay_apart_in_the_box_and_in_view(scene: MotionScene) -> None:
    objects = moving_objects(scene)
    for one in objects:
        assert (np.abs(one.positions(TIMES)) + one.solid.half).max() < 1.3
        if one.moves:
            for camera in scene_cameras(scene, "train", np.linspace(0, 1, 12), 0, size=100):
                x, y, z = camera.T_cam_world[:3, :3] @ one.positions(TIMES).T + camera.T_cam_world[:3, 3:]
                assert (z > 2).all()
                margin = 50 * one.diameter / (2 * z)
                assert (np.abs(camera.K[0, 0] * x / z) < 50 - margin).all()
                assert (np.abs(camera.K[1, 1] * y / z) < 50 - margin).all()
    for i, one in enumerate(objects):
        for other in objects[:i]:
            # Boxes are not turned: some axis separates their bounds at each time, unless one circles the other.
            space = np.abs(one.positions(TIMES) - other.positions(TIMES)) - one.solid.half - other.solid.half
            around = np.hypot(*(one.positions(TIMES) - other.positions(TIMES)).T[:2])
            column = "column" in (one.name, other.name)
            assert (
                (around.min() > 1.4 * max(one.solid.half[0], other.solid.half[0])) if column else space.max(1).min() > 0
            )


@pytest.mark.parametrize("scene", SCENES, ids=str)
def test_masks_and_clean_plates_match_the_images(scene: MotionScene, tmp_path: Path) -> None:
    """An image differs from an object's clean plate inside the mask alone, whose centroid follows the trajectory."""
    folder = write_motion(tmp_path / "scene", scene, size=64, train_times=2, test_views=4)
    record = json.loads((folder / "objects.json").read_text())
    moving = [one for one in record["objects"] if one["moves"]]
    data = load_dataset(folder)
    centred = 0
    for index, view in enumerate(data.test):
        image = view.load()
        alone = sum(np.asarray(Image.open(folder / f"masks/test/r_{index:03d}_{o['name']}.png")) > 0 for o in moving)
        for one in moving:
            mask = np.asarray(Image.open(folder / f"masks/test/r_{index:03d}_{one['name']}.png"))
            clean = np.asarray(Image.open(folder / f"clean/test/r_{index:03d}_{one['name']}.png"))
            np.testing.assert_array_equal((image != clean).any(axis=2) & (mask == 0), False)
            assert (image != clean).any(axis=2)[mask == 255].mean() > 0.9 or not (mask == 255).any()
            x, y, z = view.camera.T_cam_world[:3] @ [*one["positions"]["test"][index], 1]
            radius = view.camera.K[0, 0] * one["diameter"] / 2 / z
            whole = mask.sum() / 255 > 0.9 * np.pi * radius**2 and (alone[mask > 0] == 1).all()
            if one["shape"] == "beach ball" and whole:
                rows, columns = np.indices(mask.shape) + 0.5
                centroid = np.array([(columns * mask).sum(), (rows * mask).sum()]) / mask.sum()
                expected = view.camera.K[:2, :2] @ [x / z, y / z] + view.camera.K[:2, 2]
                assert np.abs(centroid - expected).max() < 0.5
                centred += 1
    assert centred > 0 or scene.objects == "occluded"
    assert [len(view.objects) for view in data.val] == [len(moving)] * len(data.val)


@pytest.mark.parametrize("camera_motion", ["jump", "walk", "still"])
@pytest.mark.parametrize("path", [0.5, 2, 8])
def test_the_box_enters_from_outside_the_view(camera_motion: Any, path: float) -> None:
    scene = MotionScene(path=path, objects="enter", camera=camera_motion)
    seen = {}
    for time in (0.0, 0.3, 0.5, 0.8):
        cameras = scene_cameras(scene, "train", np.linspace(0, 1, 12), 0, size=24)
        owners = [combine(trace(scene, camera, time), 9 * 24**2)[1] for camera in cameras]
        seen[time] = [int((owner == 1).sum()) for owner in owners]
    assert seen[0.0] == seen[0.3] == [0] * 12
    assert min(seen[0.5]) > 0
    assert min(seen[0.8]) > 0


def test_the_column_hides_the_ball_for_a_while() -> None:
    scene = MotionScene(path=4, objects="occluded", camera="walk", cycles=1)
    times = np.linspace(0, 1, 24)
    cameras = scene_cameras(scene, "train", times, 0, size=32)
    counts = []
    for camera, time in zip(cameras, times, strict=True):
        counts.append((combine(trace(scene, camera, time), 9 * 32**2)[1] == 0).sum())
    assert min(counts) < 0.2 * np.median(counts)


def test_a_room_fills_the_images() -> None:
    for camera_motion in ("jump", "walk", "still"):
        scene = MotionScene(camera=camera_motion, background="room")  # type: ignore[arg-type]
        for camera in scene_cameras(scene, "train", np.linspace(0, 1, 12), 0, size=24):
            assert (combine(trace(scene, camera, 0.2), 9 * 24**2)[1] < 0).mean() < 0.01


def test_still_cameras_share_their_times(tmp_path: Path) -> None:
    data = load_dataset(write_motion(tmp_path / "scene", MotionScene(camera="still"), **SMALL))
    assert len(data.train) == 24
    assert data.times.tolist() == [0, 1 / 3, 2 / 3, 1]
    places = {view.camera.position.round(9).tobytes() for view in data.train}
    held_out = {view.camera.position.round(9).tobytes() for view in data.test}
    assert (len(places), len(held_out)) == (6, 1)
    assert not places & held_out


def test_same_arguments_same_bytes_and_the_scene_is_reused(tmp_path: Path) -> None:
    scene = MotionScene(background="room")
    folder = write_motion(tmp_path / "one", scene, **SMALL)
    one = files(folder)
    assert one == files(write_motion(tmp_path / "two", scene, **SMALL))
    assert len([name for name in one if name.startswith("masks/test")]) == 6
    stamp = (folder / "train/r_000.png").stat().st_mtime_ns
    write_motion(folder, scene, **SMALL)
    assert (folder / "train/r_000.png").stat().st_mtime_ns == stamp
    with pytest.raises(InputError, match=r"holds another built-in scene .*'path': 2\.0.* instead of .*'path': 4"):
        write_motion(folder, MotionScene(background="room", path=4), **SMALL)
    assert files(folder) == one


@pytest.mark.parametrize("arguments", [{"size": 0}, {"train_times": 1}, {"test_views": 0}, {"seed": -1}])
def test_bad_arguments(tmp_path: Path, arguments: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="a motion scene needs"):
        write_motion(tmp_path / "scene", MotionScene(), **{**SMALL, **arguments})
    assert not list(tmp_path.iterdir())


def test_names_of_scenes() -> None:
    assert parse_motion("motion") == parse_motion("motion:") == MotionScene()
    name = "motion:path=4,cycles=0.5,camera=walk,background=room,objects=occluded"
    assert parse_motion(name) == MotionScene(4, 0.5, "walk", "room", "occluded")
    assert builtin_folder(name) == "motion-path4-cycles0.5-walk-room-occluded"
    assert builtin_folder("synthetic") == "synthetic"
    assert is_builtin("motion:path")
    assert not is_builtin("motions")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("motion:pth=4", "no key pth; did you mean path?"),
        ("motion:x=4", "no key x; known: path, cycles, camera, background, objects."),
        ("motion:path", "path must be a number, got ''."),
        ("motion:path=long", "path must be a number, got 'long'."),
        ("motion:path=nan", "path must lie between 0 and 2147483647, got nan."),
        ("motion:cycles=-1", "cycles must lie between 0 and 2147483647, got -1.0."),
        ("motion:camera=jmp", "camera must be jump or walk or still, got 'jmp'; did you mean jump?"),
        ("motion:background=grey", "background must be black or white or room, got 'grey'."),
        ("motion:path=1,path=2", "path is given twice."),
        ("motion:path=1,objects=occluded", "path must be at least 3 with objects=occluded"),
    ],
)
def test_mistakes_in_names(name: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.train_command(["tiny", "--data", name, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert problem in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
