"""What goes wrong with captures of one's own is told before the training, with names and numbers."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import (
    HEIGHT,
    WIDTH,
    Blobs,
    cameras,
    write_colmap,
    write_nerfies,
    write_nerfstudio,
    write_neu3d,
    write_rig,
)
from helpers.dnerf_scene import make_scene
from PIL import Image, ImageFilter

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.split import held_out
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.data.timestamps import (
    disorder,
    frame_numbers,
    in_step,
    natural_key,
    read_times,
    to_unit_range,
)
from lapgs_wgpu.data.validation import check_film, check_in_view, check_times, check_views
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.run import train
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.train.presets import load_config

CLOUD = Cloud(Blobs.random(200).means.numpy(), Blobs.random(200).colors.numpy())
WHERE = Path("points3D.bin")


def turned(camera: Camera) -> Camera:
    """Looking the other way."""
    return Camera(camera.K, np.diag([1.0, -1, -1, 1]) @ camera.T_cam_world, camera.width, camera.height)


def views(taken: list[Camera], cloud: Cloud = CLOUD) -> list[str]:
    return check_views(cloud, taken, [f"{i}.png" for i in range(len(taken))], WHERE)


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


def test_a_camera_of_many_images_counts_once() -> None:
    taken = cameras(4)
    taken[1] = turned(taken[1])
    (warning,) = views([camera for camera in taken for _ in range(10)])
    assert "10.png see none" in warning
    assert "1 of 4 cameras" in warning


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
    with pytest.raises(
        InputError, match=r"toy: .*times\.json: all 5 training images have the same time, 0.*--field static"
    ):
        check_times(data, moving=True)


LAYOUTS: dict[str, Callable[[Path, Device], Path]] = {
    "transforms_train.json": lambda folder, device: make_scene(
        folder, lambda _, scene: [frame.update(time=0.25) for frame in scene["train"]["frames"]]
    ),
    "metadata.json": lambda folder, device: write_nerfies(
        folder, device, change=lambda _, files: [entry.update(warp_id=7) for entry in files["metadata"].values()]
    ),
    "frames in": lambda folder, device: write_neu3d(folder, device, frames=1),
    "transforms.json": lambda folder, device: write_nerfstudio(
        folder, device, change=lambda _, data: [frame.update(time=3.0) for frame in data["frames"]]
    ),
}


@pytest.mark.parametrize("named", LAYOUTS)
def test_one_time_in_every_layout(named: str, device: Device, tmp_path: Path) -> None:
    """The error names the file and the field that say so."""
    data = load_dataset(LAYOUTS[named](tmp_path / "toy", device))
    with pytest.raises(InputError, match=rf"toy: .*{re.escape(named)}.* same time.*give each image its time\.$"):
        check_times(data, moving=True)
    check_times(data, moving=False)


def timed(times: Sequence[float], tested: Sequence[float] = (0.5,), taken: list[Camera] | None = None) -> Dataset:
    """A capture with a camera of its own for each time, unless given."""
    taken = taken or cameras(len(times))

    def views(split: str, times: Sequence[float]) -> tuple[View, ...]:
        return tuple(
            View(f"{split}_{i}", taken[i], time, "memory", lambda: np.zeros((HEIGHT, WIDTH, 3), np.uint8))
            for i, time in enumerate(times)
        )

    return Dataset("toy", views("train", times), views("test", tested), CLOUD)


def test_even_times_are_fine() -> None:
    assert check_times(timed(np.linspace(0, 1, 20)), moving=True) == []
    assert check_times(timed(np.repeat(np.linspace(0, 0.95, 20), 3)), moving=True) == [], "three cameras"


def test_two_times() -> None:
    (warning,) = check_times(timed([0, 0, 1, 1]), moving=True)
    assert "4 training images have only 2 different times (0, 1)" in warning
    assert "at least 5 times" in warning
    assert check_times(timed([0, 0, 1, 1]), moving=False) == []


def test_a_gap_in_time() -> None:
    times = np.concatenate([np.linspace(0, 0.3, 10), np.linspace(0.6, 1, 10)])
    (warning,) = check_times(timed(times, tested=[0.1, 0.4, 0.5]), moving=True)
    assert "no training image has a time between 0.3 and 0.6" in warning
    assert "in 2 test images" in warning
    (warning,) = check_times(timed(np.linspace(0, 0.4, 20)), moving=True)
    assert "between 0.4 and 1," in warning
    (warning,) = check_times(timed([*np.linspace(0.2, 0.4, 10), *np.linspace(0.8, 1, 10)]), moving=True)
    assert "between 0.4 and 0.8" in warning


def test_one_camera_twice_at_a_time() -> None:
    times = [0, 0.1, 0.1, 0.3, 0.5, 0.7, 0.9]
    (warning,) = check_times(timed(times, taken=[cameras(1)[0]] * 7), moving=True)
    assert "1 of 7 training images repeat the time" in warning
    assert "train_2 and train_1 at 0.1" in warning
    assert check_times(timed(times), moving=True) == [], "two cameras"


def test_cameras_that_look_away_for_a_while() -> None:
    times, taken = np.linspace(0, 1, 11), cameras(11)
    assert check_in_view(timed(times, taken=taken), CLOUD.points) == []
    for i in (1, 4, 5, 6):
        taken[i] = turned(taken[i])
    (warning,) = check_in_view(timed(times, taken=taken), CLOUD.points)
    assert "toy: all cameras look away from time 0.4 to 0.6: train_4, train_5, train_6" in warning
    together = timed(np.repeat(times, 2), taken=[camera for one in taken for camera in (one, cameras(1)[0])])
    assert check_in_view(together, CLOUD.points) == [], "another camera sees it"
    with pytest.raises(InputError, match="none of 11 training cameras sees where the first Gaussians lie"):
        check_in_view(timed(times, taken=[turned(camera) for camera in cameras(11)]), CLOUD.points)


def test_training_tells_where_cameras_look_away(
    device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = cameras(10)
    config = load_config("tiny", {"schedule.steps": "1", "points.count": "60", "field.width": "16"})
    data = timed(np.linspace(0, 1, 10), taken=[*map(turned, taken[:3]), *taken[3:]])
    train(config, data, tmp_path / "run", device=device)
    assert "warning: toy: all cameras look away from time 0 to 0.2222: train_0, " in capsys.readouterr().err
    with pytest.raises(InputError, match="none of 10 training cameras"):
        train(config, timed(np.linspace(0, 1, 10), taken=[*map(turned, taken)]), tmp_path / "none", device=device)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("kind", ["static", "mlp", "hexplane", "grid4d", "laplacian"])
def test_two_times_train(kind: str, device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Such captures, whose Nyquist limit is one cycle, stay finite."""
    fast = {"schedule.steps": "6", "schedule.warm_up": "2", "points.count": "60", "field.width": "16"}
    data = timed([0, 0, 1, 1])
    out = tmp_path / "run"
    scene = train(load_config("tiny", fast, method=kind), data, out, device=device)
    assert all(parameter.isfinite().all() for parameter in scene.parameters.values())
    assert np.isfinite(json.loads((out / "metrics.json").read_text())["psnr"])
    assert ("only 2 different times" in capsys.readouterr().err) == (kind != "static")
    if scene.spectrum is not None:
        assert scene.spectrum.frequencies.max() <= 1


def test_one_time_trains_without_motion(device: Device, tmp_path: Path) -> None:
    fast = {"schedule.steps": "3", "points.count": "60"}
    train(load_config("tiny", fast, method="static"), timed([0.5, 0.5]), tmp_path / "run", device=device)
    for kind in ("mlp", "hexplane", "grid4d", "laplacian"):
        with pytest.raises(InputError, match=r"same time, 0\.5.*--field static"):
            train(load_config("tiny", fast, method=kind), timed([0.5, 0.5]), tmp_path / kind, device=device)
        assert not (tmp_path / kind).exists()


def test_gaussians_outside_of_the_field_are_told(
    device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fast = {"schedule.steps": "2", "points.count": "60", "field.width": "16"}
    for bound, outside in (("0.5", True), ("5", False)):
        config = load_config("tiny", {**fast, "field.bound": bound})
        train(config, timed(np.linspace(0, 1, 6)), tmp_path / bound, device=device)
        assert ("Gaussians lie outside the field's box of half side 0.5" in capsys.readouterr().err) == outside


def test_frames_out_of_order() -> None:
    pictures = [ImageName(f"frame_{i:03d}.jpg", ".") for i in range(10)]
    times = [float(i) for i in range(10)]
    assert disorder(pictures, times) == []
    times[4], times[5] = times[5], times[4]
    (warning,) = disorder(pictures, times)
    assert "out of order" in warning
    assert "1 times in 10 images" in warning
    assert "frame_004.jpg at 5 to frame_005.jpg at 4" in warning


def test_cameras_with_no_time_in_common() -> None:
    pictures = [ImageName(f"cam{c}/{i + 10 * c:03d}.jpg", f"cam{c}") for c in range(2) for i in range(5)]
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
    assert warnings[0].startswith("blurred images: frame_0004.png (1 of 10)")
    assert warnings[1].startswith("repeated images: frame_0008.png (1 of 10)")


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
    one = [ImageName(f"{i}.jpg", ".") for i in range(20)]
    assert held_out(one, [i / 19 for i in range(20)]) == {4, 12}
    two = [ImageName(f"{c}/{i}.jpg", c) for i in range(6) for c in "ab"]
    assert held_out(two, [i / 5 for i in range(6) for _ in "ab"]) == {8, 9}, "both pictures of the fifth moment"
    three = [ImageName(f"cam{c}/{i}.jpg", f"cam{c}") for c in (10, 2, 9) for i in range(2)]
    assert held_out(three, [0, 1] * 3) == {2, 3}, "cam2 comes first"
    with pytest.raises(InputError, match="4 images at 4 times are too few"):
        held_out(one[:4], [0, 0.1, 0.2, 0.3])


def test_frame_numbers() -> None:
    def numbers(*names: str) -> list[int]:
        return frame_numbers([ImageName(name, str(Path(name).parent)) for name in names])

    assert numbers("IMG_20240101_001.jpg", "IMG_20240101_010.jpg") == [1, 10]
    assert numbers("a/x7.jpg", "b/x7.jpg") == [7, 7], "the same moment"
    assert numbers("cam00/v2_f1.jpg", "cam00/v2_f2.jpg", "cam01/v3_f1.jpg", "cam01/v3_f2.jpg") == [1, 2, 1, 2]
    with pytest.raises(InputError, match="differ in 2 numbers"):
        numbers("cam0_1.jpg", "cam1_2.jpg")
    assert sorted(["cam10", "cam2", "cam"], key=natural_key) == ["cam", "cam2", "cam10"]
    assert sorted(["²", "2"], key=natural_key) == ["2", "²"]


def test_cameras_that_are_nearly_in_step_share_their_times() -> None:
    """Stamps of two films, which differ by rounding and by a twentieth of a frame; the third is half a frame late."""
    frame = 1 / 30
    films = [[n * frame for n in range(300)], [0.1 + (n * frame + 0.05 * frame * (n % 2)) - 0.1 for n in range(300)]]
    films.append([(n + 0.5) * frame for n in range(300)])
    names = [ImageName(f"{c}/{n}.jpg", str(c)) for c in range(3) for n in range(300)]
    values = [time for film in films for time in film]
    assert len(set(values)) > 700
    found = in_step(names, values)
    assert np.abs(np.subtract(found, values)).max() < 0.03 * frame
    assert len(set(found)) == 600
    for c in range(3):
        assert len(set(found[300 * c : 300 * (c + 1)])) == 300, "no two of a camera"


def test_times_that_are_in_step_stay_to_the_last_bit() -> None:
    times = [n / 7 for n in range(9)]
    names = [ImageName(f"{c}/{n}.jpg", c) for c in "abc" for n in range(9)]
    assert in_step(names, 3 * times) == 3 * times
    burst = [0.0, 1.0, 1.001, 2.0]
    assert in_step([ImageName(f"{n}.jpg") for n in range(4)], burst) == burst, "one camera"
    assert len(set(in_step([*names[:4], *names[9:13]], burst + burst))) == 4, "no two of a camera"
    assert in_step(names[:1] + names[9:10], [0.0, 1.0]) == [0.0, 1.0], "one image each"


def test_times_are_from_0_to_1(tmp_path: Path) -> None:
    names = [ImageName(f"{i}.jpg", ".") for i in (1000, 1040, 1200)]
    times, source = read_times(names, tmp_path)
    assert to_unit_range(times, 1000, 1200) == [0, 0.2, 1]
    assert disorder(names, times) == []
    assert str(tmp_path) in source
