"""Captures of other programs: Record3D, Polycam, ARKit's poses in nerfstudio's form, MegaSaM, VGGT, EndoNeRF.

Each sample is what cameras see of blobs. The reader's cameras must see the same, and a short training get closer to it.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.captures import HEIGHT, WIDTH, Blobs, agreement
from helpers.external_captures import (
    COUNT,
    write_arkit,
    write_endonerf,
    write_megasam,
    write_polycam,
    write_record3d,
    write_vggt,
)
from PIL import Image

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.prepare.diagnosis import diagnose
from lapgs_wgpu.prepare.report import write_report
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.trainer import Trainer

PROGRAMS: dict[str, Callable[[Path, Device], Path]] = {
    "Record3D": write_record3d,
    "Polycam": write_polycam,
    "ARKit": write_arkit,
    "MegaSaM": write_megasam,
    "VGGT": write_vggt,
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_cameras_see_what_the_images_show(program: str, device: Device, tmp_path: Path) -> None:
    """In JPEG, or PNG."""
    data = load_dataset(PROGRAMS[program](tmp_path / "toy", device))
    assert len(data.train) + len(data.test) == COUNT
    assert data.own_footage
    assert agreement(data, Blobs.random(), device) > (30 if program in ("Record3D", "Polycam") else 45)
    times = sorted(view.time for view in (*data.train, *data.test))
    np.testing.assert_allclose(
        times, [0, 1 / 6, 1 / 3, 0.5, 2 / 3, 1] if program == "Record3D" else np.linspace(0, 1, 6)
    )


@pytest.mark.nightly
@pytest.mark.parametrize("program", [*PROGRAMS, "EndoNeRF"])
def test_a_training_gets_closer(program: str, device: Device, tmp_path: Path) -> None:
    """In 50 steps."""
    folder = (PROGRAMS | {"EndoNeRF": write_endonerf})[program](tmp_path / "toy", device)
    small = {
        "data.path": str(folder),
        "data.size": 64,
        "points.count": 800,
        "schedule.steps": 50,
        "schedule.warm_up": 20,
    }
    with Trainer(load_config("hypernerf-tiny", small), device=device) as trainer:
        results = [trainer.step() for _ in range(50)]
    first, last = (np.mean([result.psnr for result in some]) for some in (results[:10], results[-10:]))
    assert last > first + 1.5
    assert not any(result.skipped for result in results)


def test_other_forms_of_the_same_exports(device: Device, tmp_path: Path) -> None:
    data = load_dataset(write_record3d(tmp_path / "r3d", device, unpacked=True, each=False))
    assert agreement(data, Blobs.random(), device) > 30
    assert data.time_source.startswith("fps in ")
    data = load_dataset(write_polycam(tmp_path / "polycam", device, corrected=False))
    assert agreement(data, Blobs.random(), device) > 30


def test_without_points_gaussians_start_before_the_cameras(device: Device, tmp_path: Path) -> None:
    data = load_dataset(write_megasam(tmp_path / "toy", device))
    assert data.cloud is None
    assert data.depths is not None
    assert "holds 0 points" in data.warnings[0]


def test_other_poses_than_endonerfs(device: Device, tmp_path: Path) -> None:
    """poses_bounds.npy beside images/ may be LLFF's, whose axes are others."""
    folder = write_endonerf(tmp_path / "toy", device)
    rows = np.load(folder / "poses_bounds.npy")
    rows[:, 3] += np.linspace(0, 1, len(rows))
    np.save(folder / "poses_bounds.npy", rows)
    warning, *_ = load_dataset(folder).warnings
    assert "10 poses" in warning
    assert "LLFF" in warning


def test_a_phone_on_a_tripod(device: Device, tmp_path: Path) -> None:
    """Without a cloud nothing tells its depths, which is said; the scene keeps a sane size."""

    def stand(folder: Path) -> Path:
        file = folder / "metadata.json"
        data = json.loads(file.read_text())
        data["poses"] = [data["poses"][0]] * len(data["poses"])
        file.write_text(json.dumps(data))
        return folder

    data = load_dataset(stand(write_record3d(tmp_path / "toy", device)))
    assert data.cloud is None
    assert any("look in one direction" in warning and "is a guess" in warning for warning in data.warnings)
    assert data.depths is not None
    assert 0.1 < data.depths[0] < data.depths[1] < 10
    assert 0.1 < data.scale < 10


@pytest.mark.parametrize("depth", [True, False])
def test_a_camera_that_stands_still(depth: bool, device: Device, tmp_path: Path) -> None:
    """What to expect is said; depths are those of the maps, or lie between the bounds."""
    data = load_dataset(write_endonerf(tmp_path / "toy", device, depth=depth))
    assert [view.name for view in data.test] == ["test_00000", "test_00001"]
    assert [Path(view.source).name for view in data.test] == [f"frame-{i:06d}.color.png" for i in (1, 9)]
    assert len(data.cameras) == 1
    (warning,) = data.warnings
    assert "no parallax" in warning
    assert ("depths are those of" if depth else "depths are a guess") in warning
    if not depth:
        assert data.cloud is None
        return
    assert data.cloud is not None
    assert data.normalization is not None
    points = data.cloud.points / data.normalization.scale + data.normalization.center
    expected = np.asarray(Image.open(tmp_path / "toy/depth/000000.png")).astype(float).mean()
    assert np.abs(points[:, 2] - expected).max() < 0.2 * expected
    # Each point lies on the ray of its pixel: seen from the camera, the cloud is the image.
    camera = data.train[0].camera
    local = data.cloud.points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    places = (local @ camera.K.T)[:, :2] / local[:, 2:]
    image = torch.from_numpy(data.train[0].load()[..., :3].astype(np.float32) / 255)
    column, row = np.clip(places[:4000].astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
    assert np.abs(image[row, column].numpy() - data.cloud.colors[:4000]).mean() < 0.02


@pytest.mark.parametrize("program", ["Record3D", "EndoNeRF"])
def test_their_worth_is_measured(program: str, device: Device, tmp_path: Path) -> None:
    found = diagnose((PROGRAMS | {"EndoNeRF": write_endonerf})[program](tmp_path / "toy", device))
    parallax = found.measure("parallax")
    assert found.still is (program == "EndoNeRF")
    assert parallax.good is not (program == "EndoNeRF")
    assert (parallax.number > 10) is (program != "EndoNeRF")
    write_report(found, tmp_path / "report.html", program)
    assert (tmp_path / "report.html").read_text().count("<svg") == 2


def edit(path: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        file = next(folder.glob(path))
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))

    return spoil


def bounds(change: Callable[[np.ndarray], Any]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        rows = np.load(folder / "poses_bounds.npy")
        np.save(folder / "poses_bounds.npy", change(rows))

    return spoil


def with_value(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(rows: np.ndarray) -> np.ndarray:
        rows[row, column] = value
        return rows

    return change


def claim(png: Path, side: int) -> None:
    """Let a PNG's header claim so many pixels a side."""
    file = png.read_bytes()
    header = b"IHDR" + struct.pack(">II", side, side) + file[24:29]
    png.write_bytes(file[:12] + header + struct.pack(">I", zlib.crc32(header)) + file[33:])


REFUSED: dict[str, tuple[Callable[[Path, Device], Path], Callable[[Path], Any], list[str]]] = {
    "a pose too few": (write_record3d, edit("metadata.json", lambda d: d["poses"].pop()), ["5.jpg"]),
    "a quaternion too long": (
        write_record3d,
        edit("metadata.json", lambda d: d["poses"].__setitem__(2, [1, 1, 0, 0, 0, 0, 0])),
        ["frame 2"],
    ),
    "an intrinsic is text": (
        write_record3d,
        edit("metadata.json", lambda d: d["perFrameIntrinsicCoeffs"][1].__setitem__(0, "x")),
        ["perFrameIntrinsicCoeffs"],
    ),
    "times are too few": (
        write_record3d,
        edit("metadata.json", lambda d: d["frameTimestamps"].pop()),
        ["frameTimestamps"],
    ),
    "no size": (write_record3d, edit("metadata.json", lambda d: d.pop("w")), ["w"]),
    "a camera without an image": (
        write_polycam,
        lambda folder: (folder / "keyframes/images/9900000.jpg").unlink(),
        ["9900000.jpg", "9900000.json"],
    ),
    "no focal length": (write_polycam, edit("keyframes/corrected_cameras/*.json", lambda d: d.pop("fx")), ["field fx"]),
    "a matrix with scale": (
        write_polycam,
        edit("keyframes/corrected_cameras/*.json", lambda d: d.update(t_00=3.0)),
        ["is not a rotation"],
    ),
    "no cameras": (
        write_polycam,
        lambda folder: [file.unlink() for file in (folder / "keyframes/corrected_cameras").iterdir()],
        ["holds no camera"],
    ),
    "a timestamp is missing": (
        write_arkit,
        edit("transforms.json", lambda d: d["frames"][1].pop("timestamp")),
        ["frame 1 has no field timestamp"],
    ),
    "a row too few": (write_endonerf, bounds(lambda rows: rows[:-1]), ["9 poses"]),
    "depth bounds of 0": (write_endonerf, bounds(with_value(3, 15, 0.0)), ["row 3"]),
    "not a number": (write_endonerf, bounds(with_value(2, 4, np.nan)), ["row 2"]),
    "a depth map too few": (
        write_endonerf,
        lambda folder: (folder / "depth/000003.png").unlink(),
        ["9 depth maps"],
    ),
    "a depth map of another size": (
        write_endonerf,
        lambda folder: Image.fromarray(np.ones((5, 5), np.uint16)).save(folder / "depth/000000.png"),
        ["000000.png"],
    ),
    "a depth map in color": (
        write_endonerf,
        lambda folder: Image.fromarray(np.ones((HEIGHT, WIDTH, 3), np.uint8)).save(folder / "depth/000000.png"),
        ["gray"],
    ),
    "a depth map that claims to be huge": (
        write_endonerf,
        lambda folder: claim(folder / "depth/000000.png", 30_000),
        ["000000.png"],
    ),
    "a depth map that is none": (
        write_endonerf,
        lambda folder: (folder / "depth/000000.png").write_text("hello"),
        ["000000.png"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", REFUSED)
def test_mistakes_end_in_one_sentence(mistake: str, device: Device, tmp_path: Path) -> None:
    write, spoil, words = REFUSED[mistake]
    folder = write(tmp_path / "toy", device)
    spoil(folder)
    with pytest.raises(InputError) as error:
        load_dataset(folder)
    for word in words:
        assert word in str(error.value)
    assert str(error.value).count("\n") == 0
