"""The built-in scene: known motion, rendered where it should be, written whole or not at all."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from synthetic import TOYS, cameras, render, write_synthetic

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.built_in import write_built_in
from lapgs_wgpu.errors import InputError

SMALL: dict[str, Any] = {"size": 24, "train_views": 5, "test_views": 2}


def test_each_path_holds_one_frequency() -> None:
    times = np.linspace(0, 1, 101)
    for toy in TOYS:
        path = toy.path(times)
        assert path.shape == (101, 3)
        phase = 2 * np.pi * toy.cycles * times
        basis = np.stack([np.ones_like(times), np.cos(phase), np.sin(phase)], axis=1)
        np.testing.assert_allclose(basis @ np.linalg.lstsq(basis, path, rcond=None)[0], path, atol=1e-12)
        assert toy.turns or np.ptp(path, axis=0).max() > 0.5
        reach = toy.radius * (3**0.5 if toy.shape == "box" else 1)
        assert np.abs(path).max() + reach < 1.3


def test_toys_are_seen_where_their_trajectories_are() -> None:
    """What appears in the picture when a toy is added lies within the toy's outline about its projected centre."""
    times = np.linspace(0, 1, 7)
    seen = dict.fromkeys(TOYS, 0)
    for camera, time, index in zip(cameras(7, 3, size=64), times, range(7), strict=True):
        pictures = [render(camera, time, TOYS[:count]).astype(int) for count in range(len(TOYS) + 1)]
        for toy, before, after in zip(TOYS, pictures, pictures[1:], strict=False):
            rows, columns = np.nonzero((before != after).any(axis=2))
            x, y, z = camera.K @ (camera.T_cam_world @ [*toy.path(times)[index], 1])[:3]
            reach = toy.radius * (3**0.5 if toy.shape == "box" else 1) * camera.K[0, 0] / (z - toy.radius)
            offset = np.stack([columns + 0.5 - x / z, rows + 0.5 - y / z])
            assert (np.linalg.norm(offset, axis=0) < reach + 1).all()
            seen[toy] += len(rows)
            if toy is TOYS[0]:  # nothing hides it: the centres agree
                assert np.abs(offset.mean(axis=1)).max() < 1
    assert min(seen.values()) > 7 * 20


def test_the_scene_stays_as_published() -> None:
    """Measured figures hold for these very pixels: where they change, VERSION must."""
    digest = hashlib.sha256()
    for camera, time in zip(cameras(3, 0, size=48), (0.0, 0.37, 1.0), strict=True):
        digest.update(render(camera, time).tobytes())
    assert synthetic.VERSION == 1
    assert digest.hexdigest() == "4aa1f6738e87c9422d7b4832add004bceb8cd15afb2290df0f8ec4e2c77cccbd"


def test_written_scene_loads(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path / "new" / "toys", **SMALL)
    data = load_dataset(folder)
    assert data.name == "toys"
    assert [view.time for view in data.train] == [0, 0.25, 0.5, 0.75, 1]
    assert [view.time for view in data.test] == [0.375, 0.875]
    for split in ("train", "val", "test"):
        count = len(json.loads((folder / f"transforms_{split}.json").read_text())["frames"])
        assert count == len(list((folder / split).glob("*.png"))) == (5 if split == "train" else 2)

    for view in data.train + data.test:
        np.testing.assert_array_equal(view.load(), render(view.camera, view.time))


def test_the_package_holds_what_is_rendered(tmp_path: Path) -> None:
    folder = write_built_in(tmp_path / "toys")
    data = load_dataset(folder)
    assert (len(data.train), len(data.val), len(data.test)) == (100, 20, 20)
    for view in (data.train[0], data.train[61], data.test[7]):
        np.testing.assert_array_equal(view.load(), render(view.camera, view.time))


def test_it_is_unpacked_once_and_over_nothing_else(tmp_path: Path) -> None:
    folder = write_built_in(tmp_path / "toys")
    picture = folder / "train/r_000.png"
    picture.write_bytes(b"mine")
    assert write_built_in(folder) == folder
    assert picture.read_bytes() == b"mine"
    (folder / "synthetic.json").write_text("{spoilt")
    with pytest.raises(InputError, match="toys is not the built-in scene"):
        write_built_in(folder)
