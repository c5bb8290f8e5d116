"""What goes wrong with captures of one's own is told before the training, with names and numbers."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import Blobs, cameras, write_colmap, write_rig
from PIL import Image, ImageFilter

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.moments import Picture, disorder, frame_numbers, held_out, natural, times_of
from lapgs_wgpu.data.sanity import check_film, check_times, check_views
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera

CLOUD = Cloud(Blobs.random(200).means.numpy(), Blobs.random(200).colors.numpy())
WHERE = Path("points3D.bin")


def turned(camera: Camera) -> Camera:
    """Looking the other way."""
    return Camera(camera.K, np.diag([1.0, -1, -1, 1]) @ camera.T_cam_world, camera.width, camera.height)


def views(taken: list[Camera], cloud: Cloud = CLOUD) -> list[str]:
    return check_views(cloud, taken, [f"{i}.png" for i in range(len(taken))], WHERE, "turn them")


def test_nothing_is_wrong_with_a_good_capture(device: Device, tmp_path: Path) -> None:
    assert views(cameras(6)) == []
    warnings = load_dataset(write_colmap(tmp_path / "toy", device)).warnings
    assert [warning.split(":")[0] for warning in warnings] == ["the cloud is sparse"], "it has 40 points"
    assert "40 points" in warnings[0]


def test_a_camera_that_looks_away() -> None:
    taken = cameras(6)
    taken[2] = turned(taken[2])
    (warning,) = views(taken)
    assert "look away" in warning
    assert "2.png" in warning
    assert "1 of 6 cameras" in warning


def test_most_cameras_look_away() -> None:
    taken = cameras(6)
    with pytest.raises(
        InputError, match=r"points3D\.bin: cameras look away.* 4 of 6 see none.* 200 points.* turn them\.$"
    ):
        views([*map(turned, taken[:4]), *taken[4:]])


def test_cameras_at_one_place() -> None:
    camera = cameras(3)[1]
    (warning,) = views([camera, camera, camera])
    assert "hardly move" in warning
    assert "4.36 away from the cloud" in warning


@pytest.mark.parametrize("scale", [1e-5, 100.0])
def test_cloud_and_cameras_at_different_scales(scale: float, device: Device, tmp_path: Path) -> None:
    """Points that were scaled, cameras that were not."""
    folder = write_colmap(tmp_path / "toy", device, binary=False)
    path = folder / "sparse/0/points3D.txt"
    lines = path.read_text().splitlines()
    for i, line in enumerate(lines[1:], start=1):
        fields = line.split()
        fields[1:4] = [repr(scale * float(value)) for value in fields[1:4]]
        lines[i] = " ".join(fields)
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"points3D\.txt.* (coordinates|scale)"):
        load_dataset(folder)


def test_all_times_equal(device: Device, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "toy", device)
    (folder / "times.json").write_text(json.dumps({f"frame_{i:04d}.png": 7.5 for i in range(1, 7)}))
    data = load_dataset(folder)
    assert (len(data.train), len(data.test)) == (5, 1), "then pictures are counted, not moments"
    check_times(data, moving=False)
    with pytest.raises(InputError, match=r"all 5 training pictures have the same time, 0.*--field static"):
        check_times(data, moving=True)
    check_times(replace(data, train=(data.train[0], replace(data.train[1], time=1.0))), moving=True)


def test_frames_out_of_order() -> None:
    pictures = [Picture(f"frame_{i:03d}.jpg", ".") for i in range(10)]
    times = [float(i) for i in range(10)]
    assert disorder(pictures, times) == []
    times[4], times[5] = times[5], times[4]
    (warning,) = disorder(pictures, times)
    assert "out of order" in warning
    assert "1 times in 10 pictures" in warning
    assert "frame_004.jpg at 5 to frame_005.jpg at 4" in warning


def test_cameras_with_no_time_in_common() -> None:
    pictures = [Picture(f"cam{c}/{i + 10 * c:03d}.jpg", f"cam{c}") for c in range(2) for i in range(5)]
    (warning,) = disorder(pictures, [float(n) for n in frame_numbers(pictures)])
    assert "cam0 from 0 to 4" in warning
    assert "cam1 from 10 to 14" in warning


def test_blurred_and_repeated_pictures(device: Device, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "toy", device, count=10)
    path = folder / "images/frame_0004.png"
    Image.open(path).filter(ImageFilter.GaussianBlur(3)).save(path)
    shutil.copyfile(folder / "images/frame_0007.png", folder / "images/frame_0008.png")
    warnings = [warning for warning in load_dataset(folder).warnings if "sparse" not in warning]
    assert len(warnings) == 2
    assert warnings[0].startswith("blurred pictures: frame_0004.png (1 of 10)")
    assert warnings[1].startswith("repeated pictures: frame_0008.png (1 of 10)")


def test_what_moves_a_little_is_not_repeated(tmp_path: Path) -> None:
    """A still camera, noise, and a small thing that moves."""
    rng = np.random.default_rng(0)
    background = rng.integers(60, 200, (240, 320, 3)).astype(float)
    paths = []
    for i in range(6):
        picture = background + rng.normal(0, 2, background.shape)
        picture[100:104, 10 + 4 * i : 14 + 4 * i] = 255
        paths.append(tmp_path / f"{i}.jpg")
        Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(paths[-1], quality=95)
    assert check_film(paths) == []


def test_each_camera_of_a_rig_is_looked_at_alone(device: Device, tmp_path: Path) -> None:
    """Pictures of several cameras do not alternate."""
    folder = write_rig(tmp_path / "rig", device)
    shutil.copyfile(folder / "images/cam02/0001.png", folder / "images/cam02/0002.png")
    warnings = [warning for warning in load_dataset(folder).warnings if "sparse" not in warning]
    assert len(warnings) == 1
    assert "0002.png (1 of 3)" in warnings[0]


def test_held_out_views() -> None:
    one = [Picture(f"{i}.jpg", ".") for i in range(20)]
    assert held_out(one, [i / 19 for i in range(20)]) == {4, 12}
    two = [Picture(f"{c}/{i}.jpg", c) for i in range(6) for c in "ab"]
    assert held_out(two, [i / 5 for i in range(6) for _ in "ab"]) == {8, 9}, "both pictures of the fifth moment"
    three = [Picture(f"cam{c}/{i}.jpg", f"cam{c}") for c in (10, 2, 9) for i in range(2)]
    assert held_out(three, [0, 1] * 3) == {2, 3}, "cam2 comes first"
    with pytest.raises(InputError, match="4 pictures at 4 times are too few"):
        held_out(one[:4], [0, 0.1, 0.2, 0.3])


def test_frame_numbers() -> None:
    def numbers(*names: str) -> list[int]:
        return frame_numbers([Picture(name, str(Path(name).parent)) for name in names])

    assert numbers("IMG_20240101_001.jpg", "IMG_20240101_010.jpg") == [1, 10]
    assert numbers("a/x7.jpg", "b/x7.jpg") == [7, 7], "the same moment"
    assert numbers("cam00/v2_f1.jpg", "cam00/v2_f2.jpg", "cam01/v3_f1.jpg", "cam01/v3_f2.jpg") == [1, 2, 1, 2]
    with pytest.raises(InputError, match="differ in 2 numbers"):
        numbers("cam0_1.jpg", "cam1_2.jpg")
    assert sorted(["cam10", "cam2", "cam"], key=natural) == ["cam", "cam2", "cam10"]


def test_times_are_from_0_to_1(tmp_path: Path) -> None:
    times, warnings = times_of([Picture(f"{i}.jpg", ".") for i in (1000, 1040, 1200)], tmp_path)
    assert times == [0, 0.2, 1]
    assert warnings == []
