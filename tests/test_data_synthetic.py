"""The built-in scene: known motion, rendered where it should be, written whole or not at all."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lapgs_wgpu.data import load_dataset, synthetic
from lapgs_wgpu.data.synthetic import FREQUENCIES, TOYS, cameras, render, trajectories, write_synthetic
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

SMALL: dict[str, Any] = {"size": 24, "train_views": 5, "test_views": 2}


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("frequencies", [FREQUENCIES, (1.3, 2.7)])
def test_each_trajectory_holds_one_frequency(frequencies: tuple[float, ...]) -> None:
    times = np.linspace(0, 1, 101)
    paths = trajectories(times, frequencies)
    assert list(paths) == [toy.name for toy in TOYS[: len(frequencies)]]
    for toy, f in zip(TOYS, frequencies, strict=False):
        path = paths[toy.name]
        assert path.shape == (101, 3)
        phase = 2 * np.pi * f * times
        basis = np.stack([np.ones_like(times), np.cos(phase), np.sin(phase)], axis=1)
        np.testing.assert_allclose(basis @ np.linalg.lstsq(basis, path, rcond=None)[0], path, atol=1e-12)
        assert toy.turns or np.ptp(path, axis=0).max() > 0.5
        reach = toy.radius * (3**0.5 if toy.shape == "box" else 1)
        assert np.abs(path).max() + reach < 1.3


def test_toys_do_not_meet() -> None:
    paths = trajectories(np.linspace(0, 1, 401))
    for i, a in enumerate(TOYS):
        for b in TOYS[:i]:
            reach = sum(toy.radius * (2**0.5 if toy.shape == "box" else 1) for toy in (a, b))
            assert np.linalg.norm(paths[a.name] - paths[b.name], axis=1).min() > reach


def test_toys_are_seen_where_their_trajectories_are() -> None:
    """What appears in the picture when a toy is added lies within the toy's outline about its projected centre."""
    times = np.linspace(0, 1, 7)
    paths = trajectories(times)
    seen = dict.fromkeys(paths, 0)
    for camera, time, index in zip(cameras(7, 3, size=64), times, range(7), strict=True):
        pictures = [render(camera, time, FREQUENCIES[:count]).astype(int) for count in range(len(TOYS) + 1)]
        for toy, before, after in zip(TOYS, pictures, pictures[1:], strict=False):
            rows, columns = np.nonzero((before != after).any(axis=2))
            x, y, z = camera.K @ (camera.T_cam_world @ [*paths[toy.name][index], 1])[:3]
            reach = toy.radius * (3**0.5 if toy.shape == "box" else 1) * camera.K[0, 0] / (z - toy.radius)
            offset = np.stack([columns + 0.5 - x / z, rows + 0.5 - y / z])
            assert (np.linalg.norm(offset, axis=0) < reach + 1).all()
            seen[toy.name] += len(rows)
            if toy is TOYS[0]:  # nothing hides it: the centres agree
                assert np.abs(offset.mean(axis=1)).max() < 1
    assert min(seen.values()) > 7 * 20


def test_the_box_turns() -> None:
    spinner = TOYS[3]
    camera = Camera.looking_at([-1, 4, 1.5], list(spinner.centre), up=[0, 0, 1], fov_x=0.5, width=64, height=64)
    still, turned, full = (render(camera, time, (0, 0, 0, 2.0)).astype(int) for time in (0.0, 0.125, 0.5))
    assert (np.abs(still - turned).max(axis=2) > 30).sum() > 100
    assert (np.abs(still - full).max(axis=2) > 30).sum() == 0


def test_the_scene_stays_as_published() -> None:
    """Measured figures hold for these very pixels: where they change, VERSION must."""
    digest = hashlib.sha256()
    for camera, time in zip(cameras(3, 0, size=48), (0.0, 0.37, 1.0), strict=True):
        digest.update(render(camera, time).tobytes())
    assert synthetic.VERSION == 1
    assert digest.hexdigest() == "4aa1f6738e87c9422d7b4832add004bceb8cd15afb2290df0f8ec4e2c77cccbd"


def test_edges_are_smooth_and_colors_straight() -> None:
    picture = render(cameras(1, 0, size=64)[0], 0.0)
    alpha = picture[..., 3]
    assert (alpha == 0).any()
    assert (alpha == 255).any()
    edge = picture[(alpha > 0) & (alpha < 128)]
    assert len(edge) > 20
    assert np.median(edge[:, :3].max(axis=1)) > 100  # premultiplied colors would be dark here
    assert (picture[alpha == 0] == 0).all()


def test_a_static_picture_cannot_explain_the_motion() -> None:
    """The mean over time is the best that a static model could show, and it stays far below what is to be reached."""
    for camera in cameras(3, 5, size=48):
        clip = np.stack([render(camera, time)[..., :4] for time in np.linspace(0, 1, 15)]) / 255
        clip = clip[..., :3] * clip[..., 3:]
        errors = ((clip - clip.mean(axis=0)) ** 2).mean(axis=(1, 2, 3))
        assert np.mean(-10 * np.log10(errors)) < 20


def test_written_scene_loads(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path / "new" / "toys", **SMALL)
    data = load_dataset(folder)
    assert data.name == "toys"
    assert [view.time for view in data.train] == [0, 0.25, 0.5, 0.75, 1]
    assert [view.time for view in data.test] == [0.375, 0.875]
    for split in ("train", "val", "test"):
        count = len(json.loads((folder / f"transforms_{split}.json").read_text())["frames"])
        assert count == len(list((folder / split).glob("*.png"))) == (5 if split == "train" else 2)

    positions = np.stack([view.camera.position for view in data.train + data.test])
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 4)
    assert positions[:, 2].min() > 1
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + 9 * np.eye(len(positions))
    assert apart.min() > 0.1
    for view in data.train + data.test:
        np.testing.assert_array_equal(view.load(), render(view.camera, view.time))


def test_same_arguments_same_bytes(tmp_path: Path) -> None:
    one = files(write_synthetic(tmp_path / "one", **SMALL))
    assert one == files(write_synthetic(tmp_path / "two", **SMALL))
    other = files(write_synthetic(tmp_path / "three", **SMALL, seed=1))
    assert one["train/r_001.png"] != other["train/r_001.png"]


def test_the_same_scene_is_reused_and_others_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "toys"
    folder.mkdir()
    write_synthetic(folder, **SMALL)
    picture = folder / "train/r_000.png"
    stamp, before = picture.stat().st_mtime_ns, files(folder)
    write_synthetic(folder, **SMALL)
    assert picture.stat().st_mtime_ns == stamp
    with pytest.raises(InputError, match=r"toys holds another built-in scene .*seed 0 instead of 4"):
        write_synthetic(folder, **SMALL, seed=4)
    (folder / "synthetic.json").write_text("{spoilt")
    with pytest.raises(InputError, match="toys is not empty"):
        write_synthetic(folder, **SMALL)
    (folder / "synthetic.json").write_bytes(before["synthetic.json"])
    assert files(folder) == before

    (tmp_path / "file").write_text("mine")
    for target in ("file", "file/below"):
        with pytest.raises(InputError, match="file"):
            write_synthetic(tmp_path / target, **SMALL)
    assert (tmp_path / "file").read_text() == "mine"


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def interrupted(*args: Any) -> np.ndarray:
        calls.append(args)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return render(*args)

    monkeypatch.setattr(synthetic, "render", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_synthetic(tmp_path / "toys", **SMALL)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [
        {"size": 0},
        {"train_views": 1},
        {"test_views": 0},
        {"seed": -1},
        {"frequencies": ()},
        {"frequencies": (1, 2, 3, 4, 5)},
        {"frequencies": (-1.0,)},
        {"frequencies": (float("nan"),)},
    ],
)
def test_bad_arguments(tmp_path: Path, arguments: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="built-in scene needs"):
        write_synthetic(tmp_path / "toys", **{**SMALL, **arguments})
    assert not list(tmp_path.iterdir())


def test_two_frequencies_leave_two_toys(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path / "toys", **SMALL, frequencies=(1.3, 2.7))
    view = load_dataset(folder).train[2]
    np.testing.assert_array_equal(view.load(), render(view.camera, 0.5, (1.3, 2.7)))
    assert (view.load() != render(view.camera, 0.5)).any()
    assert Image.open(folder / "test/r_001.png").mode == "RGBA"
